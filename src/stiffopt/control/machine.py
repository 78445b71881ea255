"""What may be asked of the control loop, and what that does to it."""

from __future__ import annotations

from collections.abc import Callable

from stiffopt.control.checks import check_rig, check_vented_arm
from stiffopt.control.requested import highest_of, preparing
from stiffopt.control.state import State
from stiffopt.control.ticking import Ticking
from stiffopt.control.trajectory import Trajectory
from stiffopt.errors import CommandError, DeviceError, InputError, StiffoptError
from stiffopt.optimise.target import Target
from stiffopt.optimise.task import Task

__all__ = ["Machine"]

_LAST_TRIES = 3  # to vent before nobody tries any more


class Machine(Ticking):
    """Carries out requests between the ticks; `ControlLoop` has checked what they ask for.

    Each raises `InputError` with the reason where it is refused; nothing has changed then. What
    goes wrong while something changes is a fault.
    """

    def carry_out(self, request: Callable[[float], None]) -> None:
        """Do what is asked; what speaks against it is raised as `InputError`."""
        now = self._clock.now()
        try:
            request(now)
        except InputError:
            raise
        except StiffoptError as error:
            raise CommandError(str(error)) from error
        except Exception as error:
            self.fault(now, "internal", f"unexpected {type(error).__name__}: {error}")
            raise CommandError(self.lifecycle.reason) from error

    def configure(self, now: float) -> None:
        """Connect and check; see `ControlLoop.configure`."""
        self.lifecycle.permit("configure")
        with preparing("configuration"):
            try:
                if self.rig.tracker is not None:
                    self.rig.tracker.open()
                self.outlet.open()
                problems = list(check_rig(self.rig, self.outlet, self.steering))
                reading = self.outlet.read()  # now: to compile the model may take its time
            except StiffoptError as error:
                raise CommandError(f"devices: {error}") from error
            trouble = self._pressures.implausible(self._clock.now(), reading)
        if trouble is not None:
            problems.append(f"pressures: {trouble.text}")
        if problems:
            raise CommandError("; ".join(problems))
        if self.lifecycle.state is State.UNCONFIGURED:
            self.steering.begin(self._clock.now())
            self.lifecycle.change(State.INACTIVE)
            self.events.add(now, "configured", "everything answers; vented")

    def arm(self, now: float, unwanted: Callable[[], bool] = lambda: False) -> None:
        """Check, and take commands unless nobody wants that any more; see `ControlLoop.arm`."""
        self.lifecycle.permit("arm")
        with preparing("arming"):
            reading = self.outlet.read()
            problems = [
                *check_rig(self.rig, self.outlet, self.steering),
                *check_vented_arm(
                    now, self.rig, self.steering, self._pressures, reading, self._tracker
                ),
            ]
        if problems:
            raise CommandError("; ".join(problems))
        if unwanted():
            raise CommandError("the checks took longer than anybody waited; arm again")
        now = self._clock.now()  # checks may take their time
        self._vented = False
        try:
            self.outlet.arm()
            self.steering.begin(now)
        except BaseException as error:
            self._try_to_vent(now)
            if not self._vented:
                self.fault(now, "device", f"the supply could not be armed: {error}")
            raise
        self._told(now, self._zero)
        self._pressures.clear()
        self._exchanged, self._unsound, self._last = None, 0, now
        self._holds.clear()
        self.lifecycle.change(State.ACTIVE)
        self.events.add(now, "armed", "armed: pressures may change from now on")

    def disarm(self, now: float, reason: str = "disarmed") -> None:
        """Begin to let down; see `ControlLoop.disarm`."""
        self.lifecycle.permit("disarm")
        if self.lifecycle.armed:
            self._let_down(now, "disarming", reason)

    def set_task(self, now: float, task: Task) -> None:
        """Pursue a task; see `ControlLoop.set_task`."""
        self._permit_motion("set a task")
        highest = highest_of(task, self.outlet.limits)
        self.steering.set_task(task)
        try:
            self.outlet.restrict(highest)
        except DeviceError as error:  # the steering has the task, and the gate has not
            self.fault(now, "device", f"a device fails: {error}")
            raise
        self._go_on(now, "task", "there is a new task")

    def set_target(self, now: float, target: Target) -> None:
        """Go to a target; see `ControlLoop.set_target`."""
        self._permit_motion("set a target")
        self.steering.set_target(target)
        self._go_on(now, "target", "")  # these may come in a stream: no event for each

    def follow_trajectory(self, now: float, trajectory: Trajectory) -> None:
        """Follow a trajectory; see `ControlLoop.follow_trajectory`."""
        self._permit_motion("follow a trajectory")
        self.steering.follow(trajectory, now)
        self._go_on(now, "trajectory", "there is a new trajectory")

    def _permit_motion(self, request: str) -> None:
        self.lifecycle.permit(request)
        if self._ramp is not None:
            raise CommandError(f"cannot {request} while {self.lifecycle.reason}; arm again then")

    def _go_on(self, now: float, kind: str, text: str) -> None:
        if text:
            self.events.add(now, kind, text)
        for asked in ("asked", "solver"):
            self._holds.pop(asked, None)
        try:
            self._resume(now)
        except Exception as error:  # what was asked for is pursued already: no refusal any more
            self.fault(now, "internal", f"unexpected {type(error).__name__}: {error}")
            raise CommandError(self.lifecycle.reason) from error

    def hold(self, now: float, reason: str) -> None:
        """Keep the pressures; see `ControlLoop.hold`."""
        self._permit_motion("hold")
        if not isinstance(reason, str):
            raise CommandError(f"expected text as the reason, not {type(reason).__name__}")
        self._hold(now, "asked", reason)
        self.lifecycle.reason = reason

    def vent(self, now: float, reason: str) -> None:
        """Vent at once; see `ControlLoop.vent`."""
        if self.lifecycle.state is State.UNCONFIGURED:
            self.outlet.vent()
        else:
            self._end(now, reason)
            if not self._vented:
                raise CommandError(self.lifecycle.reason)

    def vent_beside(self) -> None:
        """Vent while another thread configures, which nothing of this disturbs."""
        try:
            self.outlet.vent()
        except StiffoptError as error:
            raise CommandError(
                f"it is still starting, and the supply cannot be told to vent now ({error}); it is "
                "vented when it is connected"
            ) from error

    def shut(self, now: float) -> None:
        """Vent for good, trying more than once."""
        for _ in range(_LAST_TRIES):
            if self.lifecycle.armed or not self._vented:
                self._end(now, "stopped")

    def reset(self, now: float) -> None:
        """Leave a fault whose reason is gone; see `ControlLoop.reset`."""
        self.lifecycle.permit("reset")
        left = ""
        try:
            self.outlet.vent()
            self._vented = True
            self._told(now, self._zero)
            self.alarms.clear(now, "not-vented")
            self._look(now)
        except Exception as error:  # that of a tick, which is no accident now
            left = str(error)
        if not left:
            trouble = self._trouble
            left = self._pressures.under_pressure(self.reading) if trouble is None else trouble.text
        if not left and self._tracker.jumping:
            left = "the tip still seems to jump"
        if left:
            raise CommandError(f"the reason for the fault is still there: {left}")
        self._pressures.clear()
        for kind in ("pressure-reading", "leak", "regulator-stuck", "solver"):
            self.alarms.clear(now, kind)
        self._tracker.forget()
        self.steering.begin(now)
        self.lifecycle.change(State.INACTIVE)
        self.events.add(now, "reset", "reset after a fault; vented")
