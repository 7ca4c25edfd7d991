"""Files of `mujoco.sysid`, as its 4.0.0 writes and reads them."""

import math
from pathlib import Path

import pytest

from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems import MuJoCo, read_sysid, write_sysid
from tests.catalogue.bad_sysid import GOOD

#: What `ParameterDict.save_to_disk` made of a scalar, a frozen whole number, an array,
#: a matrix and a matrix of one, with names that need quotes.
THEIRS = r"""inertia:
  frozen: false
  max_value:
  - 2.0
  - 0.0
  - .inf
  min_value:
  - 0.5
  - -1.0
  - 0.0
  name: inertia
  nominal:
  - 1.0
  - -0.25
  - 1.0e+22
  value:
  - 1.0
  - -0.25
  - 1.0e+22
it's mass:
  frozen: true
  max_value:
  - 2
  min_value:
  - 0.5
  name: it's mass
  nominal:
  - 1
  value:
  - 1
'joint/x: 1/damping':
  frozen: false
  max_value:
  - 0.3
  min_value:
  - 1.0e-06
  name: 'joint/x: 1/damping'
  nominal:
  - 2.0e-05
  value:
  - 0.000325
matrix:
  frozen: false
  max_value:
  - - 9.0
    - 9.0
  - - 9.0
    - 9.0
  min_value:
  - - 0.0
    - 0.0
  - - 0.0
    - 0.0
  name: matrix
  nominal:
  - - 1.0
    - 2.0
  - - 3.0
    - 4.5
  value:
  - - 1.0
    - 2.0
  - - 3.0
    - 4.5
"p\xFC \t \"q\"":
  frozen: false
  max_value:
  - - 1.0
  min_value:
  - - 0
  name: "p\xFC \t \"q\""
  nominal:
  - - 0.5
  value:
  - - 0.5
"""
CART = """
<mujoco><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" damping="2"/>
  <geom type="box" size=".1 .05 .02" mass=".4"/>
</body></worldbody>
<actuator><motor name="push" joint="x"/></actuator></mujoco>
"""


def box(name: str, low: float, high: float, nominal: float) -> Parameter:
    return Parameter(name, "", "", "bounded", low, high, nominal=nominal)


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    path = tmp_path / "theirs.yaml"
    path.write_text(THEIRS, encoding="utf-8")
    return path


def test_their_boxes_are_priors(theirs: Path) -> None:
    names = ["joint/x: 1/damping", "it's mass", "inertia[1]", "matrix[1,0]"]
    names.append('pü \t "q"')
    found = read_sysid(theirs, {name: f"our {i}" for i, name in enumerate(names)})
    assert found == {
        "our 0": box("our 0", 1e-6, 0.3, 2e-5),
        "our 1": 1.0,
        "our 2": box("our 2", -1.0, 0.0, -0.25),
        "our 3": box("our 3", 0.0, 9.0, 3.0),
        "our 4": box("our 4", 0.0, 1.0, 0.5),
    }


def test_without_names_all_are_read_or_refused(theirs: Path) -> None:
    with pytest.raises(InputError, match=r"E141.*inertia\[2\].*inf"):
        read_sysid(theirs)
    theirs.write_text(THEIRS.replace(".inf", "2.0e+22"), encoding="utf-8")
    rest = [f"inertia[{i}]" for i in range(3)]
    rest += [f"matrix[{i},{j}]" for i in range(2) for j in range(2)]
    names = {*rest, "joint/x: 1/damping", "it's mass", 'pü \t "q"'}
    assert set(read_sysid(theirs)) == names


def test_quotes_are_taken_off(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(GOOD.replace("a:\n", "'it''s: a':\n", 1))
    assert list(read_sysid(path)) == ["it's: a"]


TABLE = Parameters(
    (
        Parameter("gain", "N", "", "log_bounded", 1e-7, 2.5, nominal=1e-5),
        Parameter("mass", "kg", "", "log", 0.0, mean=0.0, sd=0.5),
        Parameter("offset", "m", "", "identity", mean=0.0, sd=1.0),
    ),
    (("gravity", 9.81),),
)


def test_what_is_written_is_read_the_same(tmp_path: Path) -> None:
    """Bounds of the prior, or three sd and the value; the fixed one is frozen."""
    path = tmp_path / "ours.yaml"
    values = {"gain": 3e-05, "offset": -1e22}
    write_sysid(path, TABLE, values, {"their gain": "gain", 'é "m"': "mass"})
    found = read_sysid(path)
    assert list(found) == ["gravity", "their gain", 'é "m"', "offset"]
    assert found["gravity"] == 9.81
    assert found["their gain"] == box("their gain", 1e-7, 2.5, 1e-5)
    mass, offset = found['é "m"'], found["offset"]
    assert isinstance(mass, Parameter)
    assert isinstance(offset, Parameter)
    assert (mass.low, mass.nominal) == (0.0, 1.0)
    assert mass.high == pytest.approx(math.exp(1.5))
    assert offset.low == -1e22
    assert offset.high == pytest.approx(3.0)
    text = path.read_text(encoding="utf-8")
    # Without a point in its mantissa a float is a word to YAML.
    assert "  value:\n  - 3.0e-05\n" in text
    assert "  - -1.0e+22\n" in text
    assert text.count("frozen: true") == 1
    assert '  name: "é \\"m\\""\n' in text


def test_a_model_takes_them_with_its_units(tmp_path: Path) -> None:
    (tmp_path / "cart.xml").write_text(CART)
    names = "joint/x/damping", "body/cart/mass"
    delivered = MuJoCo(tmp_path / "cart.xml", names)
    path = tmp_path / "identified.yaml"
    write_sysid(path, delivered.parameters, {"body/cart/mass": 0.5})
    system = MuJoCo(tmp_path / "cart.xml", names, priors=read_sysid(path))
    for mine, own in zip(
        system.parameters.free, delivered.parameters.free, strict=True
    ):
        assert (mine.unit, mine.meaning) == (own.unit, own.meaning)
        assert (mine.map, mine.low, mine.high) == ("bounded", own.low, own.high)
        assert mine.nominal == own.nominal
