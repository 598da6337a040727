"""Where the vehicle is, as it is told to an autopilot: Overfly's own axes, before any conversion."""

from __future__ import annotations

from dataclasses import dataclass

from overfly.geometry.poses import FloatArray, Pose

# Shares of a hundred, as MAVLink's quality field: fixes never fall below, guesses never rise above.
LEAST_FIX_QUALITY = 40
MOST_GUESS_QUALITY = 10


@dataclass(frozen=True, slots=True, eq=False)
class VehicleState:
    """A fix, or a short guess after one.

    t_ns: when the picture was taken, on our clock. world_from_body: body FLU, world z up. covariance (6, 6)
    of the perturbation world_from_body @ Pose.exp(x), x = (translation, rotation) in body axes. velocity (3,)
    m/s and its covariance (3, 3) in the world, None when not known. quality: 1 worst to 100 best; a guess has
    MOST_GUESS_QUALITY at most. reset_counter: changes, modulo 256, whenever the pose jumped.
    """

    t_ns: int
    world_from_body: Pose
    covariance: FloatArray
    velocity_m_s: FloatArray | None
    velocity_covariance: FloatArray | None
    quality: int
    reset_counter: int
    is_guess: bool = False


def body_pose(world_from_cam: Pose, covariance: FloatArray, body_from_cam: Pose) -> tuple[Pose, FloatArray]:
    """Pose and covariance (6, 6) of a camera, perturbed in its own axes -> those of the
    body, in the body's.
    """
    adjoint = body_from_cam.adjoint()
    return world_from_cam @ body_from_cam.inverse(), adjoint @ covariance @ adjoint.T
