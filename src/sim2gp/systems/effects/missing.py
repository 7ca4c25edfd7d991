"""What any machine may lack: forces on each joint, and changes of each input."""

from collections.abc import Mapping
from functools import partial

from sim2gp.systems.base import LONGEST_MEAN, AbstractSystem
from sim2gp.systems.effects import bases
from sim2gp.systems.effects.bases import Gap, Sign, StateBasis, periodic, ripple
from sim2gp.systems.effects.forces import (
    AbstractUnknownFunction,
    MissingForce,
    MissingFriction,
    MissingInput,
)
from sim2gp.systems.effects.friction_laws import COULOMB_SUBSTEP
from sim2gp.systems.effects.scales import drives
from sim2gp.systems.effects.units import joint_of
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import AbstractForcedPlant, AbstractMechanism

HARMONICS = 2  # of a joint that may turn round
RIPPLES = 12  # in a turn, of cogging
#: Of dry friction's width: the change of velocity by the drive in a substep.
WIDTH = 0.2
WIDER, WIDEST = 4.0, 0.1  # times the one before; of the range of velocities
DRY, CHANGE, GAP = 0.1, 0.1, 0.2  # prior sd, shares of the drive and of an input
GAP_WIDTH = 0.12  # median of a dead zone's width, share of an input
INPUT_REACH, INPUT_LENGTH = 1.2, 0.3  # half-widths of an input
#: Of details: how many, and half-widths of where a machine moves.
DETAILS, DETAIL_REACH, DETAIL = 16, 1.2, 0.15
DETAIL_SIZE = 0.3  # of the smooth force


def missing_forces(
    system: AbstractSystem,
    box: Mapping[str, tuple[float, float]],
    *,
    fine: bool = False,
    closely: bool = False,
    wide: bool = False,
) -> list[AbstractUnknownFunction]:
    """Of each joint a force by position, by velocity and of dry friction; of each input
    a smooth change and a dead zone.

    ``box`` is where the machine moves, by channel. With ``fine``, of each hinge the
    cogging of a motor as well, and friction that slips later. ``closely``, each
    function by position and by velocity has details too, and a joint that turns round
    is also pulled to where it started. ``wide`` friction needs no shorter substeps than
    the machine has.
    """
    plant = plant_of(system)
    # Others have short substeps, or kicks and steps that no effect can shorten.
    shorter = plant.max_substep > COULOMB_SUBSTEP
    steep = isinstance(plant, AbstractMechanism) and shorter and not wide
    friction = MissingFriction if steep else MissingForce
    # An engine holds a force for its own step, which must not reverse the joint.
    step = plant.own_step or min(plant.max_substep, LONGEST_MEAN, friction.max_substep)
    smooth = partial(bases.smooth, fixed=isinstance(plant, AbstractForcedPlant))
    details = partial(smooth, count=DETAILS, reach=DETAIL_REACH, length=DETAIL)
    found: list[AbstractUnknownFunction] = []
    for name, drive in drives(plant).items():
        joint = joint_of(plant, name)
        at = periodic(HARMONICS) if joint.turns else smooth(*box[name])
        by_speed = smooth(*box[f"{name}.velocity"])
        dry, width = DRY * drive.force, WIDTH * drive.acceleration * step
        low, high = box[f"{name}.velocity"]
        sign = _sign(width, WIDEST * (high - low) * (fine and not closely))
        if fine and joint.angle:
            found.append(MissingForce(name, dry, ripple(RIPPLES), what="ripple"))
        if closely:
            by = details(*box[name]), details(*box[f"{name}.velocity"])
            found += _details(name, drive.force, *by)
            if joint.turns:
                long = smooth(*box[name])
                found.append(
                    MissingForce(name, drive.force, long, what="pull.position_force")
                )
        found += [
            MissingForce(name, drive.force, at),
            MissingForce(
                name, drive.force, by_speed, of_velocity=True, what="velocity_force"
            ),
            friction(name, dry, sign, of_velocity=True, what="dry_friction"),
        ]
    for channel in plant.actions:
        low, high = box[channel.name]
        half, name = 0.5 * (high - low), channel.name
        change = bases.smooth(low, high, reach=INPUT_REACH, length=INPUT_LENGTH)
        found += [
            MissingInput(name, CHANGE * half, change),
            MissingInput(name, GAP * half, Gap(GAP_WIDTH * half), what="dead_zone"),
        ]
    return found


def _sign(width: float, widest: float) -> Sign:
    """Dry friction as steep as can be followed, and wider up to ``widest``.

    Nobody knows how soon a joint's friction slips: wider ones may be next to it.
    """
    widths = [width]
    while WIDER * widths[-1] < widest:
        widths.append(WIDER * widths[-1])
    return Sign(tuple(widths))


def _details(
    name: str, force: float, by_position: StateBasis, by_speed: StateBasis
) -> list[AbstractUnknownFunction]:
    """Of a joint, by position and by velocity: a spring's play, a detent, a cusp.

    They are of the kind of the smooth force: where that is on, its details may be.
    """
    size = DETAIL_SIZE * force
    return [
        MissingForce(name, size, by_position, what="detail.position_force"),
        MissingForce(
            name, size, by_speed, of_velocity=True, what="detail.velocity_force"
        ),
    ]
