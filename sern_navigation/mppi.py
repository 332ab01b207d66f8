"""The next command by model predictive path integral control (Williams et al., IROS 2016), as nav2_mppi_controller.

Many trajectories around the last best one are drawn and scored; the next is their mean, weighted by exp(-cost/λ). The
mean of two ways around a thing may go through it: a command is given only where its own trajectory is free. A few of
the trajectories follow the path (Trevisan and Alonso-Mora, Biased-MPPI, 2024): where it is narrow, hardly one of those
that are drawn at random is free.
"""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sern_core.vocabulary.errors import UsageError
from sern_navigation.costmap.costs import Costmap
from sern_navigation.costmap.escape import escaping
from sern_navigation.critics import Batch, Critics, Singles, Task, collides, look_up
from sern_twin.world.grid import Floats
from sern_twin.world.occupancy import Pose

Speed = tuple[float, float]
"""Forward [m/s] and yaw rate [rad/s] of the body."""

PATH_STEP_M: Final = 0.05
"""How far apart the points of the path are that critics see: their offsets count them, as in Nav2's maps of 5 cm."""
_SAVITZKY_GOLAY: Final = np.array([-21, 14, 39, 54, 59, 54, 39, 14, -21], np.float64) / 231
"""Quadratic, nine points (Savitzky and Golay, 1964)."""
_HISTORY: Final = 4
_SHARES: Final = (1.0, 0.5, 0.2)
"""Of the largest speed: so fast some of the trajectories follow the path."""
_LOOK_AHEAD_M: Final = 0.4
_THERE_M: Final = 0.05
_LOOKS_RAD: Final = 0.6
_TURN: Final = 2 * math.pi


class ControlCode(StrEnum):
    """Whether there is a command; the names are those of nav2_msgs/action/FollowPath."""

    NONE = "none"
    """No error."""
    INVALID_PATH = "invalid_path"
    NO_VALID_CONTROL = "no_valid_control"


@dataclass(frozen=True, slots=True)
class MppiOptions:
    """UsageError: numbers that do not fit together."""

    batch_size: int = 1000
    time_steps: int = 30
    model_dt: float = 0.1
    controller_frequency: float = 10.0
    """[Hz]: how often a command is asked for; a period is not longer than `model_dt`."""
    iteration_count: int = 1
    temperature: float = 0.3
    gamma: float = 0.015
    vx_std: float = 0.2
    wz_std: float = 0.4
    vx_max: float = 0.5
    vx_min: float = -0.35
    wz_max: float = 1.9
    ax_max: float = 3.0
    ax_min: float = -3.0
    az_max: float = 3.5
    retry_attempt_limit: int = 1
    regenerate_noises: bool = False
    """Draw anew for each command; else after each reset alone, which takes a fifth of a command less."""
    prune_distance: float = 2.0
    """[m]: how much of the path ahead counts."""
    critics: Critics = field(default_factory=Critics)

    def __post_init__(self) -> None:
        if not (4 <= self.batch_size <= 100_000 and 2 <= self.time_steps <= 1_000 and self.iteration_count >= 1):
            raise UsageError(
                f"mppi with batch_size {self.batch_size}, time_steps {self.time_steps}, iteration_count "
                f"{self.iteration_count}: give 4 to 100000, 2 to 1000, and 1 or more"
            )
        for name in (
            "model_dt",
            "controller_frequency",
            "temperature",
            "vx_std",
            "wz_std",
            "vx_max",
            "wz_max",
            "ax_max",
        ):
            if not 0 < getattr(self, name) < math.inf:
                raise UsageError(f"mppi with {name} {getattr(self, name)}: give a number above 0")
        if not (0 < self.az_max < math.inf and 0 < self.prune_distance < math.inf and 0 <= self.gamma < math.inf):
            raise UsageError("mppi: az_max and prune_distance are above 0, gamma is not below")
        if not (-math.inf < self.vx_min <= 0 and -math.inf < self.ax_min < 0 and self.retry_attempt_limit >= 0):
            raise UsageError("mppi: vx_min and ax_min are not above 0, retry_attempt_limit is not below")
        if 1 / self.controller_frequency > self.model_dt * (1 + 1e-6):
            raise UsageError(
                f"mppi with controller_frequency {self.controller_frequency} and model_dt {self.model_dt}: "
                "a period is not longer than model_dt"
            )

    @property
    def period_s(self) -> float:
        return 1 / self.controller_frequency


@dataclass(frozen=True, slots=True, eq=False)
class Control:
    """A command, (0, 0) with a `code` that is not NONE; the trajectory (steps, 3) that it begins: x, y, yaw."""

    code: ControlCode
    command: Speed
    trajectory: Floats
    message: str = ""


class Mppi:
    """One robot's controller. The same seed and the same calls give the same commands."""

    def __init__(self, options: MppiOptions, generator: np.random.Generator) -> None:
        self.options: Final = options
        self._generator = generator
        self._shifts = abs(options.period_s - options.model_dt) < 1e-6
        self._controls: Floats = np.zeros((options.time_steps, 2))
        self._history: deque[Speed] = deque([(0.0, 0.0)] * _HISTORY, maxlen=_HISTORY)
        self._noise: Singles | None = None

    def reset(self) -> None:
        """Forget the last commands: the robot was stopped, or somebody else drove it."""
        self._noise = None
        self._controls[:] = 0.0
        self._history.extend([(0.0, 0.0)] * _HISTORY)

    def command(
        self,
        pose: Pose,
        speed: Speed,
        path_m: Floats,
        goal: tuple[float, float, float | None],
        costmap: Costmap,
    ) -> Control:
        """The command for the next period. `path_m` (n, 2) is the whole path. Pose and speed are those of a robot."""
        options = self.options
        if not len(path_m):
            return _none(ControlCode.INVALID_PATH, "the path has no points")
        task = self._task(pose, path_m, goal, costmap)
        for attempt in range(options.retry_attempt_limit + 1):
            if attempt:
                self.reset()
            best = self._optimized(task, speed)
            if best is None:
                continue
            trajectory = self._driven(task.pose, best)
            if not self._meets(task, trajectory):
                return self._given(best, trajectory + np.array([pose[0], pose[1], 0.0]))
        self.reset()
        return _none(ControlCode.NO_VALID_CONTROL, "every trajectory that was tried meets an obstacle")

    def _given(self, best: Floats, trajectory: Floats) -> Control:
        options = self.options
        # One that is faster than it may be slows down as its brakes allow; it is told no more than the limits.
        command = (
            min(max(float(best[0, 0]), options.vx_min), options.vx_max),
            min(max(float(best[0, 1]), -options.wz_max), options.wz_max),
        )
        self._controls = best
        self._history.append(command)
        if self._shifts:
            self._controls = np.concatenate((best[1:], best[-1:]))
        return Control(ControlCode.NONE, command, trajectory)

    def _optimized(self, task: Task, speed: Speed) -> Floats | None:
        """The best controls (steps, 2); None where all that were drawn collide."""
        options = self.options
        controls = self._within_limits(self._controls, speed)
        follows = self._following(task)
        for _ in range(options.iteration_count):
            drawn = self._drawn(controls)
            for axis in (0, 1):
                drawn[axis][:, : len(_SHARES)] = follows[axis]
            batch = self._rolled_out(task.pose, speed, drawn)
            scores, collide = options.critics.score(batch, task)
            if collide.all():
                return None
            controls = self._mean(controls, drawn, scores, speed)
            if self._meets(task, self._driven(task.pose, controls)):
                best = int(np.argmin(scores))
                alone = np.stack([part[:, best] for part in drawn], axis=1).astype(np.float64)
                controls = self._within_limits(alone, speed)
        return controls

    def _task(self, pose: Pose, path_m: Floats, goal: tuple[float, float, float | None], costmap: Costmap) -> Task:
        """All around the robot, so that single precision does wherever on the grid it is."""
        options, (x_m, y_m, yaw_rad) = self.options, pose
        grid = replace(costmap.grid, west_m=costmap.grid.west_m - x_m, south_m=costmap.grid.south_m - y_m)
        return Task(
            (0.0, 0.0, yaw_rad),
            pruned(path_m, pose, options.prune_distance) - [x_m, y_m],
            (goal[0] - x_m, goal[1] - y_m, goal[2]),
            replace(escaping(costmap, pose), grid=grid),
            options.model_dt,
            options.vx_min,
            options.vx_max,
        )

    def _meets(self, task: Task, trajectory: Floats) -> bool:
        costs, _soft = look_up(task.costmap, *trajectory[:, :2].T.astype(np.float32))
        return bool(collides(costs).any())

    def _drawn(self, controls: Floats) -> tuple[Singles, Singles]:
        """Controls with noise, (steps, batch) of each."""
        options = self.options
        noise = self._noise
        if noise is None:
            shape = 2, options.time_steps, options.batch_size
            noise = self._generator.standard_normal(shape, dtype=np.float32)
            noise *= np.array([options.vx_std, options.wz_std], np.float32)[:, None, None]
        self._noise = None if options.regenerate_noises else noise
        mean = controls.astype(np.float32)
        return mean[:, 0, None] + noise[0], mean[:, 1, None] + noise[1]

    def _following(self, task: Task) -> tuple[Singles, Singles]:
        """Controls that follow the path by pure pursuit at some speeds, (steps, speeds) of each."""
        options = self.options
        steps = options.time_steps
        controls = np.empty((2, len(_SHARES), steps), np.float32)
        along = task.along_m.tolist()
        easts, norths = task.path_m.T.tolist()
        for number, share in enumerate(_SHARES):
            controls[:, number] = self._pursuit(task.pose, share * options.vx_max, along, easts, norths)
        return controls[0].T, controls[1].T

    def _pursuit(
        self, pose: Pose, fastest: float, along_m: list[float], easts_m: list[float], norths_m: list[float]
    ) -> tuple[list[float], list[float]]:
        """Controls that follow a path by pure pursuit (Coulter, 1992), no faster than this: speeds and yaw rates.

        One after the other in plain numbers: arrays of three would cost more than what is in them.
        """
        options, dt = self.options, self.options.model_dt
        (x, y, yaw), gone, last, segment = pose, 0.0, len(along_m) - 1, 0
        vx, wz = [], []
        for _ in range(options.time_steps):
            ahead = gone + _LOOK_AHEAD_M
            while segment < last - 1 and along_m[segment + 1] < ahead:
                segment += 1
            if ahead >= along_m[last]:
                to_x, to_y = easts_m[last] - x, norths_m[last] - y
            else:
                share = (ahead - along_m[segment]) / (along_m[segment + 1] - along_m[segment])
                to_x = easts_m[segment] + share * (easts_m[segment + 1] - easts_m[segment]) - x
                to_y = norths_m[segment] + share * (norths_m[segment + 1] - norths_m[segment]) - y
            off = math.remainder(math.atan2(to_y, to_x) - yaw, _TURN)
            looks, speed, turn = abs(off) < _LOOKS_RAD, 0.0, 0.0
            if math.hypot(to_x, to_y) >= _THERE_M:
                speed = fastest if looks else 0.0
                # Towards a point on a circle; on the spot where it lies elsewhere.
                turn = 2 * speed * math.sin(off) / _LOOK_AHEAD_M if looks else 2 * off
                turn = min(max(turn, -options.wz_max), options.wz_max)
            vx.append(speed)
            wz.append(turn)
            heading = yaw + turn * dt / 2
            x, y = x + speed * math.cos(heading) * dt, y + speed * math.sin(heading) * dt
            yaw, gone = yaw + turn * dt, gone + speed * math.cos(off) * dt
        return vx, wz

    def _rolled_out(self, pose: Pose, speed: Speed, drawn: tuple[Singles, Singles]) -> Batch:
        """Where controls lead a robot with differential drive, whose speeds change no faster than they can."""
        options = self.options
        vx, wz = drawn[0].copy(), drawn[1].copy()
        for controls, now, least, most in (
            (vx, speed[0], options.ax_min, options.ax_max),
            (wz, speed[1], -options.az_max, options.az_max),
        ):
            before, step_s, limit = np.full_like(controls[0], now), options.period_s, np.empty_like(controls[0])
            for each in controls:
                np.maximum(each, np.add(before, step_s * least, out=limit), out=each)
                np.minimum(each, np.add(before, step_s * most, out=limit), out=each)
                before, step_s = each, options.model_dt
        dt = np.float32(options.model_dt)
        yaw = _running_sum(wz * dt) + np.float32(pose[2])
        heading = yaw - wz * (dt / 2)
        x = _running_sum(vx * np.cos(heading) * dt) + np.float32(pose[0])
        y = _running_sum(vx * np.sin(heading) * dt) + np.float32(pose[1])
        return Batch(x, y, yaw, vx, wz)

    def _mean(self, controls: Floats, drawn: tuple[Singles, Singles], scores: Singles, speed: Speed) -> Floats:
        """The mean of what was drawn, by merit, smooth and within the limits."""
        options = self.options
        total = scores.astype(np.float64)
        for axis, sigma in ((0, options.vx_std), (1, options.wz_std)):
            mean = controls[:, axis].astype(np.float32)
            total += options.gamma / sigma**2 * (mean @ (drawn[axis] - mean[:, None]))
        merits = np.exp((total.min() - total) / options.temperature)
        merits = (merits / merits.sum()).astype(np.float32)
        found = np.stack([part @ merits for part in drawn], axis=1).astype(np.float64)
        return self._within_limits(self._smooth(found), speed)

    def _smooth(self, controls: Floats) -> Floats:
        padded = np.concatenate((np.array(self._history), controls, np.repeat(controls[-1:], _HISTORY, axis=0)))
        return np.stack([np.convolve(padded[:, axis], _SAVITZKY_GOLAY, mode="valid") for axis in (0, 1)], axis=1)

    def _within_limits(self, controls: Floats, speed: Speed) -> Floats:
        """Speeds and their changes that the robot has, from the speed that it has now on."""
        options = self.options
        found = np.empty_like(controls)
        vx, wz, step_s = *speed, options.period_s
        for number, (wanted_vx, wanted_wz) in enumerate(controls.tolist()):
            wanted_vx = min(max(wanted_vx, options.vx_min), options.vx_max)
            wanted_wz = min(max(wanted_wz, -options.wz_max), options.wz_max)
            vx = min(max(wanted_vx, vx + step_s * options.ax_min), vx + step_s * options.ax_max)
            wz = min(max(wanted_wz, wz - step_s * options.az_max), wz + step_s * options.az_max)
            found[number] = vx, wz
            step_s = options.model_dt
        return found

    def _driven(self, pose: Pose, controls: Floats) -> Floats:
        """Where controls (steps, 2) lead, (steps, 3)."""
        dt = self.options.model_dt
        yaw = pose[2] + np.cumsum(controls[:, 1]) * dt
        heading = yaw - controls[:, 1] * dt / 2
        steps = controls[:, 0] * dt
        return np.stack(
            (pose[0] + np.cumsum(steps * np.cos(heading)), pose[1] + np.cumsum(steps * np.sin(heading)), yaw), axis=1
        )


def _running_sum(values: Singles) -> Singles:
    """The sums over the rows up to each, (steps, batch), in place: a row at a time is half of what cumsum takes."""
    for before, row in pairwise(values):
        np.add(before, row, out=row)
    return values


def _none(code: ControlCode, message: str) -> Control:
    return Control(code, (0.0, 0.0), np.empty((0, 3)), message)


def pruned(path_m: Floats, pose: Pose, ahead_m: float) -> Floats:
    """The part of a path from where it is nearest to the robot to so far ahead, in points `PATH_STEP_M` apart."""
    if len(path_m) == 1:
        return path_m
    starts, along = path_m[:-1], np.diff(path_m, axis=0)
    lengths = np.hypot(along[:, 0], along[:, 1])
    offsets = np.array(pose[:2]) - starts
    squares: NDArray[np.float64] = np.maximum(lengths * lengths, 1e-12)
    shares = np.clip((offsets * along).sum(axis=1) / squares, 0, 1)
    away = np.hypot(*(offsets - shares[:, None] * along).T)
    nearest = int(np.argmin(away))
    travelled = np.concatenate(([0.0], np.cumsum(lengths)))
    first = travelled[nearest] + shares[nearest] * lengths[nearest]
    last = min(first + ahead_m, float(travelled[-1]))
    places = np.append(np.arange(first, last, PATH_STEP_M), last)
    return np.stack([np.interp(places, travelled, path_m[:, axis]) for axis in (0, 1)], axis=1)
