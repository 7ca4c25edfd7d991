"""Ten numbers of a body's inertia: any are a body of matter, and MuJoCo's own."""

import numpy as np
import pytest

from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.mujoco.inertia import (
    NAMES,
    BodyInertia,
    deformation,
    inertia_matrix,
    numbers,
    pseudo_inertia,
    rigid_body,
)

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

from sim2gp import systems as sy  # noqa: E402
from sim2gp.systems.mujoco.constants import constants_of, set_constants  # noqa: E402

RNG = np.random.default_rng(0)
MODEL = """<mujoco><worldbody><body name="arm">
    <joint name="q" axis="0 1 0"/>{inertial}
    <geom type="box" size=".1 .05 .02" mass="1.5" pos=".1 .02 .03" euler="10 20 30"/>
    <geom type="sphere" size=".04" mass=".3" pos=".2 0 0"/>
  </body></worldbody></mujoco>"""


def points(P: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Masses and places of four particles whose pseudo-inertia is ``P``."""
    root = np.linalg.cholesky(P)
    # The columns of root times a rotation without a zero in its last row.
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((4, 4)))[0]
    columns = root @ turn
    return columns[3] ** 2, (columns[:3] / columns[3]).T


def test_ten_numbers_are_a_deformation_of_matter() -> None:
    """Particles of the body, moved by the affine map: sums over them."""
    mass, com = 1.7, np.array([0.1, -0.2, 0.3])
    about = np.diag([0.03, 0.04, 0.05])
    weights, places = points(pseudo_inertia(mass, com, about))
    values = 0.3 * RNG.standard_normal(10)
    U = deformation(values)
    alpha, d1, d2, d3, s12, s23, s13, *t = values
    upper = [[np.exp(d1), s12, s13, t[0]], [0.0, np.exp(d2), s23, t[1]]]
    upper += [[0.0, 0.0, np.exp(d3), t[2]], [0.0, 0.0, 0.0, 1.0]]
    np.testing.assert_allclose(U, np.exp(alpha) * np.asarray(upper), rtol=1e-12)
    density, A, t = U[3, 3] ** 2, U[:3, :3] / U[3, 3], U[:3, 3] / U[3, 3]
    weights, places = density * weights, places @ A.T + t
    found = rigid_body(U @ pseudo_inertia(mass, com, about) @ U.T)
    centre = weights @ places / weights.sum()
    arms = places - centre
    squares = (arms**2).sum(1)[:, None, None] * np.eye(3)
    inertia = (
        weights[:, None, None] * (squares - arms[:, :, None] * arms[:, None])
    ).sum(0)
    assert found[0] == pytest.approx(weights.sum(), rel=1e-12)
    np.testing.assert_allclose(found[1], centre, rtol=1e-10)
    np.testing.assert_allclose(found[2], inertia, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(numbers(U), values, rtol=1e-12)


def test_any_ten_numbers_are_a_body_and_come_back() -> None:
    """Principal moments of every one obey the triangle inequality, far out as well."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(inertial=""))
    body = BodyInertia(model, 1)
    np.testing.assert_allclose(body.get(model), np.zeros(10), atol=1e-12)
    for size in (0.1, 1.0, 2.0):
        for values in size * RNG.standard_normal((30, 10)):
            body.put(model, dict(zip(NAMES, values.tolist(), strict=True)))
            moments = model.body_inertia[1]
            assert model.body_mass[1] > 0.0
            assert moments.min() > 0.0
            assert 2.0 * moments.max() <= moments.sum() * (1.0 + 1e-12)
            np.testing.assert_allclose(body.get(model), values, atol=1e-6)


def test_a_density_is_a_mass() -> None:
    """``alpha`` alone is what `mass` does: the inertia goes with it."""
    model = mujoco.MjModel.from_xml_string(MODEL.format(inertial=""))
    known = constants_of(model)
    other = mujoco.MjModel.from_xml_string(MODEL.format(inertial=""))
    set_constants(model, [(known["body/arm/inertia/alpha"], 0.5 * np.log(1.3))])
    set_constants(other, [(known["body/arm/mass"], 1.3 * 1.8)])
    assert model.body_mass[1] == pytest.approx(2.34, rel=1e-12)
    np.testing.assert_allclose(inertia_matrix(model, 1), inertia_matrix(other, 1))
    np.testing.assert_allclose(model.body_ipos, other.body_ipos, rtol=1e-12)


def test_it_is_written_and_compiled_as_the_same_body(tmp_path) -> None:
    """Into an inertial of its own, over one that is there, and over a centre."""
    written = '<inertial pos="0 0 .1" euler="0 30 0" mass="2" diaginertia=".1 .2 .25"/>'
    centred = '<inertial pos="0 0 0" mass="2" diaginertia=".25 .2 .1"/>'
    values = dict(zip(NAMES, (0.3 * RNG.standard_normal(10)).tolist(), strict=True))
    for inertial in ("", written, centred):
        path = tmp_path / "arm.xml"
        path.write_text(MODEL.format(inertial=inertial))
        system = sy.MuJoCo(path, ["body/arm/inertia"])
        assert system.names == tuple(f"body/arm/inertia/{name}" for name in NAMES)
        theta = np.asarray(list(values.values()))
        named = dict(zip(system.names, theta.tolist(), strict=True))
        file = system.file()
        ((_, _, text),) = file.texts(file.edited(named), "new.xml", tmp_path)
        assert text.count(b"fullinertia") == 1
        made = mujoco.MjModel.from_xml_string(text.decode())
        file.check(file.edited(named), made)
        wanted = system.engine.with_values(theta)
        for field in ("body_mass", "body_ipos"):
            pair = (getattr(m, field) for m in (made, wanted))
            np.testing.assert_allclose(*pair, rtol=1e-10)
        moved = []
        for model in (made, wanted):
            data = mujoco.MjData(model)
            for _ in range(50):
                mujoco.mj_step(model, data)
            moved.append([data.qpos[0], *data.geom_xpos.ravel()])
        np.testing.assert_allclose(*moved, rtol=1e-9, atol=1e-12)
        found = constants_of(system.engine.model)[system.names[4]].get(wanted)
        assert found == pytest.approx(theta[4], rel=1e-9)


def test_its_priors_are_about_the_model(tmp_path) -> None:
    """And it cannot be open twice."""
    model = mujoco.MjModel.from_xml_string(
        MODEL.format(inertial="").replace("<body ", '<body simple="false" ')
    )
    table = sy.MuJoCo(model, ["body/*/inertia"]).parameters
    assert [p.constrain(p.mean) for p in table.free] == [0.0] * 10
    assert table.free[-1].unit == "m"
    with pytest.raises(InputError, match=r"E145.*body/arm/com_x, and.*inertia"):
        sy.MuJoCo(model, ["body/arm/inertia", "body/arm/com_x"])
    ball = '<mujoco><worldbody><body name="b"><joint/><geom size=".1"/></body>'
    plain = mujoco.MjModel.from_xml_string(ball + "</worldbody></mujoco>")
    with pytest.raises(InputError, match=r"E172 body/b/inertia/alpha.*simple="):
        sy.MuJoCo(plain, ["body/b/inertia"])


def test_a_centre_moves_where_it_was_at_the_origin(tmp_path) -> None:
    """MuJoCo simplifies such a body, and its shapes lie in its inertial frame."""
    text = """<mujoco><worldbody><body name="b"><joint axis="0 1 0"/>
      <inertial pos="{} 0 0" mass="1" diaginertia=".03 .02 .01"/>
      <geom size=".1"/></body></worldbody></mujoco>"""
    path = tmp_path / "b.xml"
    path.write_text(text.format(0.0))
    place = Parameter("", "m", "place", "identity", mean=0.0, sd=0.1)
    system = sy.MuJoCo(path, ["body/b/com_x"], {"body/b/com_x": place})
    made = mujoco.MjModel.from_xml_string(text.format(0.07))
    moved = []
    for model in (made, system.engine.with_values(np.array([0.07]))):
        data = mujoco.MjData(model)
        for _ in range(100):
            mujoco.mj_step(model, data)
        moved.append([data.qpos[0], *data.geom_xpos.ravel()])
    assert abs(moved[0][0]) > 0.1
    np.testing.assert_allclose(*moved, rtol=1e-9, atol=1e-12)
