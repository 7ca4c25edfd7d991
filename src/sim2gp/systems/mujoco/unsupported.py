"""What a model may not have: every refusal (E172) is here, and names the element.

The state of a machine is ``(qpos, qvel, act)`` of hinges and slides, its inputs are one
number for each actuator. What MuJoCo keeps beyond these numbers from one step to the
next would be lost, and what a program moves from outside would be an unknown input. All
else (contacts, limits, equality constraints, tendons, muscles) is C MuJoCo's own step.
"""

from typing import Any

import numpy as np

from sim2gp.errors import error
from sim2gp.systems.mujoco.constants import name_of

#: Words of `mujoco.mjtDyn`, `mjtGain`, `mjtBias` that a step of ours knows.
_DYNAMICS = ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT", "MUSCLE")
_GAINS = ("FIXED", "AFFINE", "MUSCLE")
_BIASES = ("NONE", "AFFINE", "MUSCLE")


def check_supported(model: Any) -> None:
    """Refuse a compiled model with what is not supported, in one line (E172)."""
    for check in (_joints, _bodies, _actuators, _delays, _state):
        check(model)


def _joints(model: Any) -> None:
    if model.njnt == 0:
        raise error("model_without_joints", got=_model_name(model))
    for j in range(model.njnt):
        if model.jnt_type[j] not in (2, 3):
            of_type = ("free", "ball")[model.jnt_type[j]]
            got = f"{name_of(model, 'joint', j)} ({of_type})"
            raise error("joint_with_quaternion", got=got)


def _bodies(model: Any) -> None:
    for b in np.flatnonzero(model.body_mocapid >= 0).tolist():
        raise error("mocap_body", got=name_of(model, "body", b))
    for i in range(model.nflex):
        raise error("deformable_body", got=_name(model, "flex", i))


def _actuators(model: Any) -> None:
    """One input, one force, and at most one activation each, of a known kind."""
    import mujoco

    kinds = (
        ("dyn", mujoco.mjtDyn, _DYNAMICS),
        ("gain", mujoco.mjtGain, _GAINS),
        ("bias", mujoco.mjtBias, _BIASES),
    )
    for i in range(len(model.actuator_trntype)):
        name = name_of(model, "actuator", i)
        for kind, words, known in kinds:
            word = words(getattr(model, f"actuator_{kind}type")[i]).name.split("_")[1]
            if word not in known:
                raise error(
                    "actuator_of_unknown_type",
                    got=name,
                    expected=", ".join(known).lower(),
                    setting=f"{kind}type",
                    word=word.lower(),
                )
        for what in ("act", "ctrl", "out"):
            count = getattr(model, f"actuator_{what}num", None)
            if count is not None and count[i] > 1:  # before MuJoCo 4 only act
                raise error(
                    "actuator_with_several_inputs",
                    got=f"{what}num {count[i]} of {name}",
                )


def _delays(model: Any) -> None:
    """Past inputs and readings would be part of the state (MuJoCo 3.5 or newer)."""
    for kind, fix in (
        ("actuator", "delete the two; in a project [actuators.NAME] has a delay"),
        ("sensor", "delete the two; a sensor's delay moves nothing"),
    ):
        samples = getattr(model, f"{kind}_history", None)
        for i in np.flatnonzero(() if samples is None else np.any(samples, axis=-1)):
            name = name_of(model, kind, int(i))
            raise error(
                "delay_of_its_own",
                got=f"delay or nsample of {name}",
                fix=fix.replace("NAME", f'"{name}"'),
                element=kind,
            )


def _state(model: Any) -> None:
    """Nothing else that MuJoCo remembers from step to step."""
    import mujoco

    for i in range(model.nplugin):
        raise error("model_with_plugin", got=_name(model, "plugin", i))
    for kind, short in (("joint", "jnt"), ("tendon", "tendon")):
        places = getattr(model, f"{short}_plasticadr", np.empty(0))  # MuJoCo 4
        for i in np.flatnonzero(places >= 0).tolist():
            got = f"springyield of {name_of(model, kind, i)}"
            raise error("spring_that_yields", got=got, element=kind)
    sleep = getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)
    if model.opt.enableflags & int(sleep):
        raise error("bodies_that_sleep", got='option flag sleep="enable"')
    whole = mujoco.mj_stateSize(model, int(mujoco.mjtState.mjSTATE_FULLPHYSICS))
    more = whole - 1 - model.nq - model.nv - model.na  # one is the time
    if more:
        got = f"{more} more numbers in {_model_name(model)}"
        raise error("state_beyond_activations", got=got)


def _name(model: Any, kind: str, index: int) -> str:
    """The element and its name, of a kind that the model has no accessor for."""
    import mujoco

    number = int(getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"))
    return f"{kind} {mujoco.mj_id2name(model, number, index) or index}"


def _model_name(model: Any) -> str:
    return f"model {model.names.split(bytes(1), 1)[0].decode()}".strip()
