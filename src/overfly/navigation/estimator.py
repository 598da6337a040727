"""Where the vehicle is now: fixes in the map, the commands in between, and the time that all of it takes.

A Kalman filter on position, velocity, yaw and yaw rate (Bar-Shalom, Li, Kirubarajan: Estimation with
Applications to Tracking and Navigation, 2001, sections 5 and 6). The vehicle is expected to follow its
commands with a lag; what else moves it, wind or a hand, is white acceleration. A fix is as old as its
picture: the filter stands at the time of the picture, and is carried on to the present by the commands given
since.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from overfly.geometry.poses import FloatArray, Pose, euler_from_rotation, skew, wrap_angle
from overfly.navigation.vehicle import Airframe
from overfly.types import VelocityCommand

NS_PER_S = 1e9
LONGEST_STEP_S = 0.05
LEAST_DISTURBANCE_M_S2 = 1.0  # a hand, a gust: of any vehicle
DISTURBANCE_SHARE = 0.5  # of what the vehicle itself can accelerate
YAW_DISTURBANCE_RAD_S2 = 1.0
GATE_CHI2 = 40.0  # of four degrees of freedom: one true fix in twenty million lies beyond
MOST_REFUSED = 3  # fixes beyond the gate, one after the other, that are then believed
SEAM_SHARE = 0.004  # of the height: how far parts of a map that meet may disagree, a pixel of 320
LEAST_SIGMA_RAD = 0.003
POSITION, VELOCITY, YAW, YAW_RATE = slice(0, 3), slice(3, 6), 6, 7


@dataclass(frozen=True, slots=True, eq=False)
class PlaceFix:
    """Where the body was when the picture was taken: position (3,) and yaw in the map's world, covariance
    (4, 4) of both."""

    t_ns: int
    position: FloatArray
    yaw_rad: float
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class VehicleState:
    """Position (3,) m and velocity (3,) m/s in the map's world, yaw and its rate; covariance (8, 8) of all in
    this order."""

    t_ns: int
    position: FloatArray
    velocity: FloatArray
    yaw_rad: float
    yaw_rate_rad_s: float
    covariance: FloatArray

    @property
    def horizontal_sigma_m(self) -> float:
        """Root mean square of the deviations along x and y, summed."""
        return math.sqrt(float(self.covariance[0, 0] + self.covariance[1, 1]))


def place_fix(
    t_ns: int, world_from_cam: Pose, covariance: FloatArray | None, body_from_cam: Pose
) -> PlaceFix:
    """The body's place from the camera's. covariance (6, 6): of world_from_cam @ Pose.exp(x)."""
    cam_from_body = body_from_cam.inverse()
    world_from_body = world_from_cam @ cam_from_body
    R = world_from_cam.rotation
    jacobian = np.zeros((4, 6))
    jacobian[:3, :3] = R
    jacobian[:3, 3:] = -R @ skew(cam_from_body.translation)
    jacobian[3, 3:] = R[2]  # the turn about the vertical
    found = np.zeros((4, 4)) if covariance is None else jacobian @ covariance @ jacobian.T
    seam_m = SEAM_SHARE * abs(float(world_from_cam.translation[2]))
    found += np.diag([seam_m**2] * 3 + [LEAST_SIGMA_RAD**2])
    yaw = euler_from_rotation(world_from_body.rotation)[2]
    return PlaceFix(t_ns, world_from_body.translation, yaw, found)


class Estimator:
    """Feed it fixes and commands in the order of time; ask it for the state at any later moment."""

    def __init__(self, airframe: Airframe) -> None:
        self._airframe = airframe
        self._disturbance = max(LEAST_DISTURBANCE_M_S2, DISTURBANCE_SHARE * airframe.max_acceleration_m_s2)
        self._state: VehicleState | None = None
        self._commands: list[tuple[int, VelocityCommand]] = []  # and when each took effect
        self._refused = 0
        self.last_fix_ns: int | None = None
        self.n_resets = 0

    @property
    def state(self) -> VehicleState | None:
        """As of the last picture; None before the first fix."""
        return self._state

    def commanded(self, t_ns: int, command: VelocityCommand) -> None:
        """The vehicle follows this command from t_ns on."""
        self._commands.append((t_ns, command))
        while (
            self._state is not None and len(self._commands) > 1 and self._commands[1][0] <= self._state.t_ns
        ):
            del self._commands[0]

    def at(self, t_ns: int) -> VehicleState | None:
        """The state carried on to t_ns by the commands; None before the first fix."""
        return None if self._state is None else self._carried(self._state, t_ns)

    def see(self, fix: PlaceFix) -> bool:
        """Take a fix in; False when it cannot be true by what was known, and is not believed yet.

        The map may have been corrected, or the camera been found again far from where it was thought to be:
        fixes that say so several times in a row are right, and the filter begins anew from there.
        """
        if self._state is None:
            self._begin(fix)
            return True
        state = self._carried(self._state, fix.t_ns)
        self._state = state
        H = np.zeros((4, 8))
        H[[0, 1, 2, 3], [0, 1, 2, YAW]] = 1.0
        innovation = np.append(fix.position - state.position, wrap_angle(fix.yaw_rad - state.yaw_rad))
        S = H @ state.covariance @ H.T + fix.covariance
        if float(innovation @ np.linalg.solve(S, innovation)) > GATE_CHI2:
            self._refused += 1
            if self._refused < MOST_REFUSED:
                return False
            self.n_resets += 1
            self._begin(fix, state)
            return True
        self._update(state, H, innovation, S, fix.covariance)
        self.last_fix_ns, self._refused = fix.t_ns, 0
        return True

    def see_height(self, t_ns: int, z_m: float, sigma_m: float) -> None:
        """Take in a height alone, while there is no fix."""
        if self._state is None:
            return
        state = self._carried(self._state, t_ns)
        H = np.zeros((1, 8))
        H[0, 2] = 1.0
        noise = np.array([[sigma_m**2]])
        self._update(state, H, np.array([z_m - state.position[2]]), H @ state.covariance @ H.T + noise, noise)

    def pass_time(self, t_ns: int) -> None:
        """A picture that told nothing: the state is what the commands make of it."""
        if self._state is not None:
            self._state = self._carried(self._state, t_ns)

    def move(self, position: FloatArray) -> None:
        """The map was corrected, and this is where the same place now lies in it."""
        if self._state is not None:
            self._state = replace(self._state, position=position)

    def _begin(self, fix: PlaceFix, before: VehicleState | None = None) -> None:
        covariance = np.zeros((8, 8))
        covariance[:3, :3], covariance[YAW, YAW] = fix.covariance[:3, :3], fix.covariance[3, 3]
        covariance[VELOCITY, VELOCITY] = np.eye(3) * (0.5 * self._airframe.max_speed_m_s) ** 2
        covariance[YAW_RATE, YAW_RATE] = self._airframe.max_yaw_rate_rad_s**2
        velocity = np.zeros(3) if before is None else before.velocity
        self._state = VehicleState(fix.t_ns, fix.position.copy(), velocity, fix.yaw_rad, 0.0, covariance)
        self.last_fix_ns, self._refused = fix.t_ns, 0

    def _update(
        self, state: VehicleState, H: FloatArray, innovation: FloatArray, S: FloatArray, noise: FloatArray
    ) -> None:
        gain = np.linalg.solve(S, H @ state.covariance).T
        step = gain @ innovation
        keep = np.eye(8) - gain @ H
        covariance = keep @ state.covariance @ keep.T + gain @ noise @ gain.T  # Joseph's form stays positive
        self._state = VehicleState(
            state.t_ns,
            state.position + step[POSITION],
            state.velocity + step[VELOCITY],
            wrap_angle(state.yaw_rad + step[YAW]),
            state.yaw_rate_rad_s + step[YAW_RATE],
            covariance,
        )

    def _carried(self, state: VehicleState, t_ns: int) -> VehicleState:
        """Through all commands that were in force between then and t_ns."""
        command = VelocityCommand()
        for begins_ns, following in self._commands:
            if begins_ns > state.t_ns:
                state = self._flown(state, command, min(begins_ns, t_ns))
            if begins_ns >= t_ns:
                break
            command = following
        return self._flown(state, command, t_ns)

    def _flown(self, state: VehicleState, command: VelocityCommand, t_ns: int) -> VehicleState:
        remaining = (t_ns - state.t_ns) / NS_PER_S
        while remaining > 1e-9:
            step = min(remaining, LONGEST_STEP_S)
            state = self._step(state, command, step)
            remaining -= step
        return replace(state, t_ns=max(t_ns, state.t_ns))

    def _step(self, state: VehicleState, command: VelocityCommand, dt: float) -> VehicleState:
        airframe = self._airframe
        pull = (velocity_in_world(command, state.yaw_rad) - state.velocity) / airframe.response_s
        strength = float(np.linalg.norm(pull[:2]))
        if strength > airframe.max_acceleration_m_s2:
            pull[:2] *= airframe.max_acceleration_m_s2 / strength
        turn = (command.yaw_rate_rad_s - state.yaw_rate_rad_s) * min(1.0, dt / max(airframe.pull_lag_s, dt))
        F = np.eye(8)
        F[POSITION, VELOCITY] = dt * np.eye(3)
        F[YAW, YAW_RATE] = dt
        noise = np.zeros((8, 8))
        spread = np.array([[0.25 * dt**4, 0.5 * dt**3], [0.5 * dt**3, dt**2]])
        # White noise of the given strength over tenths of a second, whatever the step.
        per_step = 0.1 / dt
        for axis in range(3):
            noise[np.ix_([axis, axis + 3], [axis, axis + 3])] = spread * self._disturbance**2 * per_step
        noise[np.ix_([YAW, YAW_RATE], [YAW, YAW_RATE])] = spread * YAW_DISTURBANCE_RAD_S2**2 * per_step
        return VehicleState(
            state.t_ns + round(dt * NS_PER_S),
            state.position + dt * state.velocity + 0.5 * dt**2 * pull,
            state.velocity + dt * pull,
            wrap_angle(state.yaw_rad + dt * state.yaw_rate_rad_s),
            state.yaw_rate_rad_s + turn,
            F @ state.covariance @ F.T + noise,
        )


def velocity_in_world(command: VelocityCommand, yaw_rad: float) -> FloatArray:
    """(3,) m/s of a command given in the heading frame."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    forward, left = command.forward_m_s, command.left_m_s
    return np.array([c * forward - s * left, s * forward + c * left, command.up_m_s])


def command_in_heading(velocity: FloatArray, yaw_rad: float, yaw_rate_rad_s: float) -> VelocityCommand:
    """The command for a velocity (3,) m/s in the world."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    x, y, z = (float(value) for value in velocity)
    return VelocityCommand(c * x + s * y, c * y - s * x, z, yaw_rate_rad_s)
