"""Files that a MuJoCo model names: where they are looked for, and none outside."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from crawler import CRAWLER, USUAL, written
from hostile_models import tetrahedron
from sim2gp.errors import InputError
from sim2gp.systems.mujoco import load as mjcf_load

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

MESH = """<mujoco><compiler {compiler}/><asset><mesh name="m" {mesh}/></asset>
<worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
#: Attributes of the compiler and of a mesh that lead to ../secret.stl.
SPELLED = {
    "a reference": ('meshdir="&#46;."', 'file="secret.stl"'),
    "a hexadecimal one": ('assetdir=".&#x2e;"', 'file="secret.stl"'),
    "zeros": ('assetdir=".&#x0002E;"', 'file="secret.stl"'),
    "a bracket before": ("", 'class="a>b" file="../secret.stl"'),
    "in the file's name": ("", 'file="&#x2e;&#x2e;&#47;secret.stl"'),
    "backslashes": ("", r'file="..\secret.stl"'),
    "a link": ("", 'file="link.stl"'),
    "stripped": ('meshdir=".." strippath="true"', 'file="any/secret.stl"'),
}


@pytest.mark.parametrize("spelling", SPELLED)
def test_no_spelling_of_a_path_leads_outside(tmp_path: Path, spelling: str) -> None:
    """Whatever an XML parser makes of it: the mesh is next to the folder, and loads."""
    (tmp_path / "secret.stl").write_bytes(tetrahedron(0.1))
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "link.stl").symlink_to("../secret.stl")
    compiler, mesh = SPELLED[spelling]
    path = written(folder, MESH.format(compiler=compiler, mesh=mesh))
    with pytest.raises(InputError, match=r"E171 .* outside the model's folder"):
        mjcf_load.compiled(path)
    if spelling in ("a reference", "backslashes"):
        assert mjcf_load.compiled(path, tmp_path).nmesh == 1
    part = f"<include {mesh.replace('class', 'x').replace('.stl', '.xml')}/>"
    path.write_text(f"<mujoco>{part}</mujoco>")
    with pytest.raises(InputError, match=r"E17[01] (include outside|no model)"):
        mjcf_load.compiled(path)


#: Where MuJoCo looks for the files of each: main text, parts by name, meshes by size.
LAYOUTS = {
    "folders": (
        '<compiler meshdir="a/b/.." assetdir="c"/><asset><mesh name="m" '
        'file="./p/x.stl"/><mesh name="n" file="q\\x.stl"/></asset>',
        {},
        {"a/p/x.stl": 0.1, "a/q/x.stl": 0.2, "x.stl": 0.3, "c/x.stl": 0.4},
    ),
    "assetdir": (
        '<compiler assetdir="c"/><asset><mesh name="m" file="x.stl"/></asset>',
        {},
        {"c/x.stl": 0.1, "x.stl": 0.2},
    ),
    "a later compiler": (
        '<compiler assetdir="c"/><compiler meshdir="d"/><asset>'
        '<mesh name="m" file="x.stl"/></asset>',
        {},
        {"c/x.stl": 0.1, "d/x.stl": 0.2},
    ),
    "up and down": (
        '<compiler meshdir="c"/><asset><mesh name="m" file="../d/x.stl"/></asset>',
        {},
        {"d/x.stl": 0.1, "c/x.stl": 0.2},
    ),
    "a part next to it": (
        '<compiler meshdir="c"/><include file="one.xml"/>',
        {"one.xml": '<asset><mesh name="m" file="x.stl"/></asset>'},
        {"x.stl": 0.1},
    ),
    "strippath": (
        '<compiler strippath="true" meshdir="c"/><asset>'
        '<mesh name="m" file="far/off/x.stl"/></asset>',
        {},
        {"c/x.stl": 0.1, "c/far/off/x.stl": 0.2},
    ),
    "parts of parts": (
        '<include file="sub/one.xml"/>',
        {
            "sub/one.xml": '<asset><mesh name="m" file="x.stl"/></asset>'
            '<include file="deep/two.xml"/>',
            "sub/deep/two.xml": '<asset><mesh name="n" file="y.stl"/></asset>',
        },
        {"sub/x.stl": 0.1, "sub/deep/y.stl": 0.2, "y.stl": 0.3},
    ),
    "a part's own folder": (
        '<include file="sub/one.xml"/>',
        {
            "sub/one.xml": '<compiler meshdir="d"/><asset><mesh name="m" file="x.stl"/>'
            "</asset>"
        },
        {"d/sub/x.stl": 0.1, "sub/d/x.stl": 0.2, "sub/x.stl": 0.3},
    ),
    "another model": (
        '<compiler meshdir="d"/><asset><mesh name="m" file="x.stl"/>'
        '<model name="k" file="sub/k.xml"/></asset>',
        {
            "sub/k.xml": '<compiler meshdir="e"/><asset><mesh name="n" file="x.stl"/>'
            '</asset><worldbody><body name="b"><joint/><geom type="mesh" mesh="n"/>'
            "</body></worldbody>"
        },
        {"d/x.stl": 0.1, "sub/e/x.stl": 0.2, "x.stl": 0.3, "e/x.stl": 0.4},
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_files_are_found_where_mujoco_finds_them(tmp_path: Path, layout: str) -> None:
    """The same model as MuJoCo makes of the folder itself."""
    text, parts, meshes = LAYOUTS[layout]
    used = [f'<body><joint/><geom type="mesh" mesh="{n}"/></body>' for n in ("m", "n")]
    used = used[: 1 + ('"n"' in text + "".join(parts.values()))]
    if layout == "another model":
        used[1] = '<attach model="k" body="b" prefix="k"/>'
    for name, inner in parts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"<mujoco>{inner}</mujoco>")
    for name, size in meshes.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(tetrahedron(size))
    for name in ("a/b", "sub"):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
    whole = f"<mujoco>{text}<worldbody>{''.join(used)}</worldbody></mujoco>"
    path = written(tmp_path, whole)
    expected = mujoco.MjModel.from_xml_path(str(path))
    found = mjcf_load.compiled(path)
    assert found.nmesh == expected.nmesh == len(used)
    np.testing.assert_array_equal(found.body_mass, expected.body_mass)
    np.testing.assert_array_equal(found.mesh_vert, expected.mesh_vert)


def test_a_file_has_every_name_that_mujoco_may_ask_for(tmp_path: Path) -> None:
    """Without one MuJoCo takes any file with the same last part of the name."""
    from sim2gp.systems.mujoco.sources import read_sources

    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "x.stl").write_bytes(tetrahedron(0.1))
    part = '<mujoco><asset><mesh file="x.stl"/></asset></mujoco>'
    (tmp_path / "sub" / "one.xml").write_text(part)
    text = '<mujoco><compiler meshdir="d"/><include file="sub/one.xml"/></mujoco>'
    found = read_sources(written(tmp_path, text), tmp_path)
    assert set(found.assets) == {"d/x.stl", "sub/x.stl", "d/sub/x.stl"}
    assert set(found.assets.values()) == {tetrahedron(0.1)}
    assert found.texts == {"one.xml": part.encode()}


def test_forms_that_mujoco_reads_though_they_are_not_xml(tmp_path: Path) -> None:
    """Rules of hyphens in comments, a blank line first, a prefix without namespace."""
    text = CRAWLER.format(**USUAL)
    rules = "<!-- ---- the robot ---- -->\n"
    text = '\n<?xml version="1.0"?>' + text.replace(
        "<worldbody>", rules + "<worldbody>"
    )
    assert mjcf_load.compiled(written(tmp_path, text)).njnt == 4
    many = written(tmp_path, text.replace(rules, 101 * rules + "<body"))
    with pytest.raises(InputError, match="E170 no model"):
        mjcf_load.compiled(many)
    for bad in ('<!DOCTYPE mujoco [<!ENTITY a "b">]>', "<?run me?>"):
        path = written(tmp_path, bad + CRAWLER.format(**USUAL).strip())
        with pytest.raises(InputError, match=r"E170 no model.*(document type|<\?run)"):
            mjcf_load.compiled(path)


@pytest.mark.skipif(sys.platform == "win32", reason="no limits")
def test_the_child_opens_no_file_after_it_has_read_its_own(tmp_path: Path) -> None:
    """A text that names a file, past the guard: the compiler gets nothing of it."""
    from sim2gp.systems.mujoco.sources import Sources

    (tmp_path / "x.stl").write_bytes(tetrahedron(0.1))
    text = MESH.format(compiler="", mesh=f'file="{tmp_path}/x.stl"')
    mjcf_load._hand_over(tmp_path, 0, ".xml", Sources(text.encode()))
    command = [sys.executable, "-I", mjcf_load._CHILD, "60", str(tmp_path), "mjb", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 3
    assert re.search(r"REFUSED Error.*x\.stl", done.stderr)
