"""The text of a model's file as a tree, for checks: nothing in it is resolved.

MuJoCo's own parser reads UTF-8 even if a file declares another encoding, and knows no
document types. What the two parsers could understand differently is refused here:
document types and their entities, processing instructions, XInclude, and text that is
not well formed. Of the forms that MuJoCo reads all the same, those that real models
have are let through.
"""

import math
import re
from collections.abc import Iterator
from typing import Any

from sim2gp.errors import InputError, error, missing_extra

UNREAD = "a MuJoCo model cannot be read"
#: `--` in a comment, a prefix without its namespace, blank lines before `<?xml`: both
#: parsers read on and find the same elements.
_HARMLESS = {
    "ERR_HYPHEN_IN_COMMENT",
    "NS_ERR_UNDEFINED_NAMESPACE",
    "ERR_RESERVED_XML_NAME",
}
_REPORTED = 100  # errors of a file: libxml2 does not report more
_NOT_FINITE = re.compile(r"[+-]?(nan(\(.*\))?|inf(inity)?)", re.IGNORECASE)
_XINCLUDE = "{http://www.w3.org/2001/XInclude}"
#: Attributes that hold names and words: an object may be called "nan".
_WORDS = frozenset(
    "name class childclass model prefix frame plugin instance key content_type "
    "body body1 body2 joint joint1 joint2 jointinparent geom geom1 geom2 site site1 "
    "site2 sidesite refsite cranksite slidersite tendon tendon1 tendon2 actuator "
    "sensor camera light flex mesh hfield skin material texture target objname refname "
    "subtree1 subtree2 node link gridlayout type".split()
)


def parsed(data: bytes, where: str) -> Any:
    """The root element of a file's bytes (an `lxml` element).

    Raises `InputError` E170 for what is no plain XML in UTF-8 and for a number that is
    not finite, with the line, and E135 where lxml is not installed.
    """
    try:
        from lxml import etree
    except ImportError as error:
        raise missing_extra(UNREAD, error, "mujoco") from None

    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise _refused(f"{where}:line {line}", "bytes that are not UTF-8") from None
    parser = etree.XMLParser(
        encoding="utf-8",  # MuJoCo ignores what the file declares
        resolve_entities=False,
        load_dtd=False,
        no_network=True,
        huge_tree=False,
        recover=True,
    )
    try:
        root = etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        raise _refused(where, str(error.msg)) from None
    for entry in parser.error_log:
        if entry.type_name not in _HARMLESS:
            raise _refused(f"{where}:line {entry.line}", entry.message)
    if root is None or len(parser.error_log) >= _REPORTED:
        raise _refused(where, "too many errors")
    if root.getroottree().docinfo.internalDTD is not None:
        raise _refused(where, "a document type")
    _check(root, data, where, etree)
    return root


def elements(root: Any) -> Iterator[Any]:
    """Elements in the order of the text, without comments."""
    return (each for each in root.iter() if isinstance(each.tag, str))


def bare(name: str) -> str:
    """A tag or an attribute's name in lower case, without its namespace."""
    return re.split(r"[}:]", name)[-1].lower()


def place(element: Any, data: bytes, where: str) -> str:
    """``file:line 7``, where the element's start tag begins."""
    lines = data.split(b"\n")[: element.sourceline]  # that its start tag ends in
    name = re.split(r"[}:]", element.tag)[-1].encode()
    begins = re.compile(rb"<([^\s<>/]*:)?" + re.escape(name) + rb"(?![^\s/>])")
    for number in range(len(lines), 0, -1):
        if begins.search(lines[number - 1]):
            return f"{where}:line {number}"
    return f"{where}:line {element.sourceline}"


def _check(root: Any, data: bytes, where: str, etree: Any) -> None:
    for each in root.getroottree().xpath("//processing-instruction()"):
        if each.target == "xml":  # a declaration, after blank lines
            continue
        got = f"the instruction <?{each.target} ...?>"
        raise _refused(f"{where}:line {each.sourceline}", got)
    for each in elements(root):
        if each.tag.startswith(_XINCLUDE):
            raise _refused(place(each, data, where), "XInclude")
        words = () if _of_visual(each) else _WORDS
        for name, value in each.attrib.items():
            text = bare(name) in words or (name, bare(each.tag)) == ("data", "text")
            if not text and any(_endless(word) for word in value.split()):
                raise error(
                    "attribute_not_finite",
                    where=place(each, data, where),
                    got=value,
                    attribute=name,
                    element=bare(each.tag),
                )


def _of_visual(element: Any) -> bool:
    """Colours and sizes of what is drawn, by the names of kinds of objects."""
    parent = element.getparent()
    return parent is not None and bare(parent.tag) == "visual"


def _endless(word: str) -> bool:
    if _NOT_FINITE.fullmatch(word):
        return True
    try:
        return math.isinf(float(word))  # 1e999
    except ValueError:
        return False


def _refused(where: str, got: str) -> InputError:
    return error("not_plain_xml", where=where, got=" ".join(got.split()))
