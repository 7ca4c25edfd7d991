"""The text of a model's files, changed attribute by attribute.

Every element knows where its start tag is in its file. Edits are collected, and applied
to the bytes at the end: what no edit names (comments, order, white space, the way that
other numbers are written) stays as it is.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import escape

from sim2gp.errors import InputError, error

_ATTRIBUTE = re.compile(rb"""\s+([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")
_TAG = re.compile(rb"""<([^\s/>]+)(?:"[^"]*"|'[^']*'|[^"'>])*?(/?)>""")
_NUMBER = re.compile(r"\S+")


@dataclass(eq=False)
class Document:
    """One file: its bytes, and where it lies."""

    path: Path
    data: bytes


@dataclass(eq=False)
class Element:
    """One element: its attributes, its place in its file, and its relatives.

    The children of an ``include`` are in its place, as MuJoCo reads them.
    """

    tag: str
    attributes: dict[str, str]
    document: Document
    start: int  # of its start tag, in bytes
    parent: "Element | None" = None
    children: list["Element"] = field(default_factory=list)

    def all(self, *tags: str) -> Iterator["Element"]:
        """Children of these kinds."""
        return (child for child in self.children if child.tag in tags)

    def stated(self, name: str) -> str:
        """An attribute as it is in the file, with its tabs and line breaks."""
        tag = _TAG.match(self.document.data, self.start)
        pairs = _ATTRIBUTE.finditer(tag.group()) if tag else ()
        found = {p.group(1).decode(): p.group(2).decode()[1:-1] for p in pairs}
        return found.get(name, "")

    @property
    def line(self) -> str:
        """``file:line 7``."""
        number = self.document.data.count(b"\n", 0, self.start) + 1
        return f"{self.document.path}:line {number}"


@dataclass(eq=False)
class Files:
    """A model's file and those that it includes: the tree, and each include's file."""

    root: Element
    documents: list[Document]
    includes: list[tuple[Element, Document]]


def read_files(path: Path, data: bytes | None = None) -> Files:
    """Parse a file (its text, where given) and what it includes (E130, E170)."""
    files = Files(_parsed(_document(path, data)), [], [])
    files.documents.append(files.root.document)
    if files.root.tag == "mujoco":
        _include(files.root, files, path.parent)
    return files


def _document(path: Path, data: bytes | None = None) -> Document:
    try:
        return Document(path, path.read_bytes() if data is None else data)
    except OSError as caught:
        raise error("unreadable_file", got=caught.strerror, file=path) from None


def _include(element: Element, files: Files, folder: Path) -> None:
    """Put the children of included files in their place; paths are the model's."""
    found: list[Element] = []
    for child in element.children:
        if child.tag != "include":
            _include(child, files, folder)
            found.append(child)
            continue
        path = folder / child.attributes["file"]
        if any(path.resolve() == d.path.resolve() for d in files.documents):
            raise _unreadable(path, "a file that is included twice")
        part = _parsed(_document(path))
        files.documents.append(part.document)
        files.includes.append((child, part.document))
        _include(part, files, folder)
        for inner in part.children:
            inner.parent = element
        found += part.children
    element.children = found


def _parsed(document: Document) -> Element:
    parser = expat.ParserCreate()
    open_: list[Element] = []
    roots: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        parent = open_[-1] if open_ else None
        found = Element(tag, attributes, document, parser.CurrentByteIndex, parent)
        (parent.children if parent else roots).append(found)
        open_.append(found)

    def doctype(*_: object) -> None:
        raise _unreadable(document.path, "a document type")

    def encoding(version: str, name: str | None, alone: int) -> None:
        if (name or "utf-8").lower() not in ("utf-8", "us-ascii", "ascii"):
            raise _unreadable(document.path, f"the encoding {name}")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_.pop()
    parser.StartDoctypeDeclHandler = doctype
    parser.XmlDeclHandler = encoding
    try:
        parser.Parse(document.data, True)
    except expat.ExpatError as error:
        raise _unreadable(document.path, str(error)) from None
    return roots[0]


def _unreadable(path: Path, got: str) -> InputError:
    return error("text_cannot_be_changed", where=str(path), got=got)


class Edits:
    """Changes of elements, and the bytes of a file with them."""

    def __init__(self) -> None:
        self._attributes: dict[Element, dict[str, str | None]] = {}
        self._tags: dict[Element, str] = {}
        self._within: dict[Element, dict[str, list[str]]] = {}

    def copy(self) -> "Edits":
        """The same changes, to which others can be added."""
        found = Edits()
        found._attributes = {k: dict(v) for k, v in self._attributes.items()}
        found._tags = dict(self._tags)
        found._within = {
            element: {wrap: list(texts) for wrap, texts in each.items()}
            for element, each in self._within.items()
        }
        return found

    @property
    def touched(self) -> set[Document]:
        """Files that are not what they were."""
        every = (*self._attributes, *self._tags, *self._within)
        return {element.document for element in every}

    def get(self, element: Element, name: str) -> str | None:
        """An attribute as it is now."""
        now = self._attributes.get(element, {})
        return now[name] if name in now else element.attributes.get(name)

    def set(self, element: Element, name: str, value: str | None) -> None:
        """Give an attribute another value; None takes it away."""
        if self.get(element, name) != value:
            self._attributes.setdefault(element, {})[name] = value

    def set_numbers(
        self,
        element: Element,
        name: str,
        numbers: Mapping[int, float],
        rest: "Mapping[int, float] | None" = None,
    ) -> None:
        """Put numbers at their places in an attribute; others stay as they are written.

        ``rest`` fills places before them that the attribute does not state.
        """
        now = self._attributes.get(element, {})
        text = (now[name] or "") if name in now else element.stated(name)
        words = _NUMBER.findall(text)
        if len(words) <= max(numbers):  # rewritten whole, as it gets longer
            more = range(len(words), max(numbers) + 1)
            known = {**(rest or {}), **numbers}
            words += [number(known[i]) for i in more]
        for i, value in numbers.items():
            if float(words[i]) != value:
                words[i] = number(value)
        self.set(element, name, _spaced(text, words))

    def rename(self, element: Element, tag: str) -> None:
        """Make it an element of another kind (one that has no children)."""
        self._tags[element] = tag

    def insert(self, parent: Element, text: str, wrap: str = "") -> None:
        """Put an element first among the children, all in one new element ``wrap``."""
        self._within.setdefault(parent, {}).setdefault(wrap, []).append(text)

    def applied(self, document: Document) -> bytes:
        """The file with its changes; without any, the same bytes."""
        changed = {*self._attributes, *self._tags, *self._within}
        mine = [e for e in changed if e.document is document]
        data = document.data
        for element in sorted(mine, key=lambda e: -e.start):
            data = self._applied(element, data)
        return data

    def _applied(self, element: Element, data: bytes) -> bytes:
        found = _TAG.match(data, element.start)
        if found is None:
            raise _unreadable(element.document.path, f"the tag {element.tag}")
        tag, rest = data[: found.end()], data[found.end() :]
        head, text = tag[: element.start], tag[element.start :]
        for name, value in self._attributes.get(element, {}).items():
            text = _with_attribute(text, name, value)
        renamed = self._tags.get(element)
        if renamed is not None:
            old = found.group(1)
            text = b"<" + renamed.encode() + text[1 + len(old) :]
            if not found.group(2):
                rest = rest.replace(b"</" + old, b"</" + renamed.encode(), 1)
        inner: list[bytes] = []
        for wrap, texts in self._within.get(element, {}).items():
            whole = "".join(texts)
            whole = f"<{wrap}>{whole}</{wrap}>" if wrap else whole
            inner.append(whole.encode())
        if inner and found.group(2):
            text = text[:-2].rstrip() + b">" + b"".join(inner)
            text += b"</" + found.group(1) + b">"
        elif inner:
            space = re.match(rb"\s*", rest)
            gap = space.group() if space else b""
            text += b"".join(gap + x for x in inner)
        return head + text + rest


def number(x: float) -> str:
    """The shortest text that is read as the same number."""
    return repr(float(x)).removesuffix(".0")


def _with_attribute(tag: bytes, name: str, value: str | None) -> bytes:
    """A start tag with an attribute replaced, added after the last one, or removed."""
    last = len(re.match(rb"<[^\s/>]+", tag).group())  # type: ignore[union-attr]
    for found in _ATTRIBUTE.finditer(tag):
        last = found.end()
        if found.group(1).decode() != name:
            continue
        if value is None:
            return tag[: found.start()] + tag[found.end() :]
        quote = found.group(2)[:1]
        new = quote + _escaped(value, quote.decode()).encode() + quote
        return tag[: found.start(2)] + new + tag[found.end(2) :]
    if value is None:
        return tag
    new = f' {name}="{_escaped(value, chr(34))}"'.encode()
    return tag[:last] + new + tag[last:]


def _escaped(value: str, quote: str) -> str:
    return escape(value, {quote: "&quot;" if quote == '"' else "&apos;"})


def _spaced(old: str, words: list[str]) -> str:
    """Words with the old ones' white space between them."""
    gaps = _NUMBER.split(old)
    if len(gaps) < 2:
        return " ".join(words)
    first, last = gaps[0], gaps[-1]
    between = gaps[1:-1] + [" "] * len(words)
    body = words[0] + "".join(g + w for g, w in zip(between, words[1:], strict=False))
    return first + body + last
