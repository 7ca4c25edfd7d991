"""Model files that name a file outside their folder, from a grammar of tricks.

The folder `model` holds what is drawn here; `outside`, next to it, holds a sentinel of
every kind of file that MuJoCo reads, whose mass would show.
"""

import ctypes
import ctypes.util
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: Kinds of elements that name a file, and the sentinel's name.
KINDS = {
    "mesh": "secret.stl",
    "include": "secret.xml",
    "model": "secret.mjcf.xml",
    "flexcomp": "secret.obj",
    "hfield": "secret.bin",
    "skin": "secret.skn",
    "texture": "secret.png",
    "cube": "secret.png",
    "urdf": "secret.stl",
    "config": "secret.stl",
}
SHOWN = {777.0, 500.0 / 3.0}  # masses of the sentinels' bodies
INNER = 1.0 / 48.0  # of the mesh inside
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BODY = '<body name="secret"><joint/><geom size=".1" mass="777"/></body>'
WORLD = f"<mujoco><worldbody>{BODY}</worldbody></mujoco>"
MESH = (
    '<worldbody><body><joint/><geom type="mesh" mesh="a"/></body></worldbody></mujoco>'
)
URDF = """<robot name="r">{more}<link name="b"/><link name="c"><inertial>
<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><mesh {attributes}/></geometry></collision></link>
<joint name="j" type="continuous"><parent link="b"/><child link="c"/></joint></robot>"""


def tetrahedron(size: float) -> bytes:
    """A mesh in binary STL, of mass 500/3 size^3 at MuJoCo's density."""
    corners = size * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
    out = bytes(80) + struct.pack("<I", 4)
    for face in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]):
        out += bytes(12) + corners[face].tobytes() + bytes(2)
    return out


def furnish(folder: Path) -> tuple[Path, Path]:
    """The model's folder with a mesh of its own and links, and the one outside."""
    outside, model = folder / "outside", folder / "model"
    (model / "sub").mkdir(parents=True)
    outside.mkdir()
    heights = struct.pack("<ii4f", 2, 2, 0.0, 0.0, 0.0, 0.0)
    (outside / "secret.stl").write_bytes(tetrahedron(1.0))
    (outside / "secret.xml").write_text(WORLD)
    (outside / "secret.mjcf.xml").write_text(WORLD)
    (outside / "secret.obj").write_text(OBJ)
    (outside / "secret.bin").write_bytes(heights)
    (outside / "secret.skn").write_bytes(struct.pack("<4i", 0, 0, 0, 0))
    (outside / "secret.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    for place in (model, model / "sub"):
        (place / "inner.stl").write_bytes(tetrahedron(0.05))
    (model / "link").symlink_to("../outside")
    for name in set(KINDS.values()):
        (model / f"linked_{name}").symlink_to(outside / name)
    return model, outside


@dataclass(frozen=True)
class Hostile:
    """One model: its own file, and one that it includes, where the trick is there."""

    text: bytes
    part: bytes | None
    suffix: str
    tricks: tuple[str, ...]

    def write(self, folder: Path) -> Path:
        path, part = folder / f"hostile{self.suffix}", folder / "sub" / "part.xml"
        for file, data in ((path, self.text), (part, self.part)):
            file.unlink(missing_ok=True)  # to overwrite would wait for the disk
            if data is not None:
                file.write_bytes(data)
        return path


def hostile(rng: np.random.Generator, folder: Path) -> Hostile:
    """One document; ``folder`` is the model's."""
    tricks: list[str] = []

    def pick(*options: str) -> str:
        return options[int(rng.integers(len(options)))]

    kind = pick(*KINDS)
    value = _spelling(pick, tricks, KINDS[kind], folder)
    return _document(rng, pick, tricks, kind, value)


def _spelling(pick, tricks: list[str], name: str, folder: Path) -> str:
    """A path to the sentinel, or what some reader could take for one."""
    top = folder.parent
    forms = {
        "up": f"../outside/{name}",
        "down and up": f"sub/../../outside/{name}",
        "dots": f"./.././outside/./{name}",
        "slashes": f"..//outside///{name}",
        "far up": f"../../{top.name}/outside/{name}",
        "absolute": f"{top}/outside/{name}",
        "double root": f"/{top}/outside/{name}",
        "absolute and up": f"{folder}/../outside/{name}",
        "linked folder": f"link/{name}",
        "linked file": f"linked_{name}",
        "up from a link": f"link/../outside/{name}",
        "through a link": f"sub/../link/./{name}",
        "backslashes": f"..\\outside\\{name}",
        "both slashes": f"sub\\../..\\outside/{name}",
        "drive": f"C:\\outside\\{name}",
        "drive and up": f"C:../outside/{name}",
        "share": f"\\\\{top.name}\\outside\\{name}",
        "file url": f"file://{top}/outside/{name}",
        "http": f"http://localhost/outside/{name}",
        "package": f"package://../outside/{name}",
        "model url": f"model://../outside/{name}",
        "percent": f"%2e%2e/outside/{name}",
        "percent slash": f"%2e%2e%2foutside%2f{name}",
        "wide dots": f"\uff0e\uff0e/outside/{name}",
        "ellipsis": f"\u2025/outside/{name}",
        "combining": f".\u200d./outside/{name}",
        "spaces": f" ../outside/{name} ",
        "tab": f"\t../outside/{name}",
        "line break": f"\n../outside/{name}\n",
        "home": f"~/../outside/{name}",
        "variable": f"$PWD/../outside/{name}",
        "capitals": f"../outside/{name}".upper(),
        "archive": f"inner.zip/../../outside/{name}",
        "null": f"../outside/{name}\0",
    }
    form = pick(*forms)
    tricks.append(form)
    return forms[form]


def _document(rng, pick, tricks: list[str], kind: str, value: str) -> Hostile:
    compiler, file = "", value
    folder = {"texture": "texturedir", "cube": "texturedir"}.get(kind, "meshdir")
    separated = kind not in ("include", "model", "config") and "/" in value
    if separated and rng.random() < 0.4:
        where, _, file = value.rpartition("/")
        name = pick(folder, "assetdir")
        tricks.append(name)
        more = pick("", ' strippath="true"', ' angle="radian"', " texturedir='sub'")
        more = "" if name == "texturedir" or name == "assetdir" else more
        tag = pick("compiler", "compiler", "COMPILER")
        compiler = f"<{tag} {name}={_quoted(rng, pick, tricks, where)}{more}/>"
    quoted = _quoted(rng, pick, tricks, file)
    before = pick("", "", ' name="a>b"', " class='x&gt;' ", '\n\t name = "a/>"')
    if before:
        tricks.append("a bracket before")
    space = pick("", " ", "\n", "\t")
    word = {"urdf": "filename", "config": "value"}.get(kind, "file")
    word = pick("fileright", "fileback") if kind == "cube" else word
    if rng.random() < 0.03:
        word, tricks = f"{word}='inner.stl' {word}", [*tricks, "twice"]
    attributes = f"{before} {word}{space}={space}{quoted}"
    if kind == "urdf":
        part = f"<mujoco>{compiler}</mujoco>" if compiler else ""
        text = URDF.format(more=part, attributes=attributes)
        return _written(rng, pick, tricks, text, None, ".urdf")
    text = f"<mujoco>{_noise(rng, pick, tricks)}{compiler}{_element(kind, attributes)}"
    if rng.random() < 0.25 and kind != "include":
        tricks.append("in a part")
        up = pick(
            "sub/part.xml", "./sub/part.xml", "sub//part.xml", "sub&#x2f;part.xml"
        )
        main = f"<mujoco><{pick('include', 'INCLUDE')} file='{up}'/></mujoco>"
        return _written(rng, pick, tricks, main, text, ".xml")
    return _written(rng, pick, tricks, text, None, ".xml")


def _element(kind: str, attributes: str) -> str:
    """The rest of a model in which one element has these attributes."""
    if kind in ("include", "model"):
        tail = "<worldbody><attach model='m' body='secret' prefix='p'/></worldbody>"
        if kind == "include":
            return f"<include {attributes}/></mujoco>"
        return f"<asset><model name='m' {attributes}/></asset>{tail}</mujoco>"
    if kind == "flexcomp":
        flex = "name='f' type='mesh' dim='2' mass='777' radius='.01'"
        return f"<worldbody><flexcomp {flex} {attributes}/></worldbody></mujoco>"
    if kind == "config":
        inner = f"<instance name='i'><config key='k' {attributes}/></instance>"
        inner = f"<plugin plugin='mujoco.pid'>{inner}</plugin>"
        return f"<extension>{inner}</extension></mujoco>"
    more = {"hfield": "size='1 1 1 1'", "cube": "type='cube'"}.get(kind, "")
    tag = "texture" if kind == "cube" else kind
    named = "" if "name" in attributes else "name='a'"
    rest = MESH if kind == "mesh" else "</mujoco>"
    return f"<asset><{tag} {named} {more} {attributes}/></asset>{rest}"


def _quoted(rng, pick, tricks: list[str], value: str) -> str:
    """The value as an attribute, some characters by references."""
    quote = pick('"', "'")
    way = pick(*["plain", "some", "some", "all"] * 4, "again", "entity")
    if way != "plain":
        tricks.append(f"characters: {way}")
    if way == "entity":
        return f"{quote}&{pick('e', 'f', 'ext')};{quote}"
    out = []
    for letter in value:
        if way == "plain" or (way == "some" and rng.random() < 0.6):
            out.append("&amp;" if letter == "&" else letter)
            continue
        zeros = "0" * int(rng.integers(4))
        code = pick(f"#{zeros}{ord(letter)}", f"#x{zeros}{ord(letter):x}")
        code = pick(code, code, f"#x{zeros}{ord(letter):X}")
        out.append(f"&amp;{code};" if way == "again" else f"&{code};")
    return quote + "".join(out) + quote


def _noise(rng, pick, tricks: list[str]) -> str:
    if rng.random() < 0.8:
        return ""
    found = pick(
        "<!-- <mesh file='inner.stl'/> -->",
        "<!-- a -- b --><!--> <!---> -->",
        "<![CDATA[ <!-- ]]>",
        "<?php <!-- ?>",
        "<?xml-stylesheet href='../outside/secret.xml'?>",
        "<xi:include xmlns:xi='http://www.w3.org/2001/XInclude' "
        "href='../outside/secret.xml'/>",
        "<x:compiler xmlns:x='urn:x' meshdir='../outside'/>",
        "<default><default class='x'><geom mesh='a'/></default></default>",
    )
    tricks.append(f"noise {found[:9]}")
    return found


def _written(
    rng, pick, tricks: list[str], text: str, part: str | None, suffix: str
) -> Hostile:
    """Bytes in some encoding, with a declaration and a document type or without."""
    inner = text if part is None else part
    value = "../outside/secret.stl"
    if "&e;" in inner or "&f;" in inner or "&ext;" in inner or rng.random() < 0.03:
        top = pick(
            f"<!ENTITY e '{value}'><!ENTITY f '&#38;e;'><!ENTITY ext SYSTEM '{value}'>",
            f"<!ENTITY % p \"<!ENTITY e '{value}'>\">%p;<!ENTITY f '&e;'>"
            f"<!ENTITY ext SYSTEM '{value}'>",
            f"<!ENTITY % d SYSTEM 'file:{value}'>%d;",
        )
        tricks.append("document type")
        inner = f"<!DOCTYPE {pick('mujoco', 'robot')} [{top}]>{inner}"
    encoding = "utf-8"
    if rng.random() < 0.1:
        encoding = pick("utf-16", "utf-16-le", "utf-7", "latin-1", "utf-8-sig", "cp037")
        tricks.append(encoding)
    if rng.random() < 0.3:
        named = pick(encoding, "utf-8", "UTF-7", "iso-8859-1", "UTF-16", "bogus")
        inner = f"{pick('', chr(10))}<?xml version='1.0' encoding='{named}'?>{inner}"
    data = inner.encode(encoding, errors="xmlcharrefreplace")
    if part is None:
        return Hostile(data, None, suffix, tuple(tricks))
    return Hostile(text.encode(), data, suffix, tuple(tricks))


@contextmanager
def watched(folder: Path) -> Iterator[list[str]]:
    """Names of files in a folder that any process opens meanwhile (Linux)."""
    libc = ctypes.CDLL(ctypes.util.find_library("c"), use_errno=True)
    handle = libc.inotify_init1(os.O_NONBLOCK)
    assert handle >= 0, os.strerror(ctypes.get_errno())
    opened: list[str] = []
    try:
        watch = libc.inotify_add_watch(handle, bytes(folder), 0x20)  # IN_OPEN
        assert watch >= 0, os.strerror(ctypes.get_errno())
        yield opened
        while True:
            try:
                events = os.read(handle, 1 << 20)
            except BlockingIOError:
                break
            while events:
                size = struct.unpack_from("iIII", events)[3]
                opened.append(events[16 : 16 + size].rstrip(b"\0").decode())
                events = events[16 + size :]
    finally:
        os.close(handle)
