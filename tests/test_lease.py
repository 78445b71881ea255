"""Who has control: one client, as long as it is heard."""

from __future__ import annotations

import pytest

from fake_loop import ManualClock
from stiffopt.daemon.lease import ControlLease
from stiffopt.daemon.reports import RefusalError


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def lease(clock: ManualClock) -> ControlLease:
    return ControlLease(1.0, clock)


def test_one_client_has_control_and_the_others_are_told_who(
    lease: ControlLease, clock: ManualClock
) -> None:
    identity = lease.take("planner")
    clock.time += 0.25
    with pytest.raises(RefusalError, match=r"'planner' has control; it ends in 0\.75 s"):
        lease.take("other")
    with pytest.raises(RefusalError, match="'planner' has it"):
        lease.renew("made up")
    lease.renew(identity)
    holder = lease.holder
    assert holder is not None
    assert (holder.client, holder.expires_in_s) == ("planner", 1.0)
    lease.release(identity)
    assert lease.holder is None
    assert lease.take("other") != identity


def test_a_renewed_lease_lasts(lease: ControlLease, clock: ManualClock) -> None:
    identity = lease.take("planner")
    for _ in range(20):
        clock.time += 0.9
        assert lease.check(clock.time) is None
        lease.renew(identity)


def test_what_is_not_renewed_is_lost_and_stays_lost(
    lease: ControlLease, clock: ManualClock
) -> None:
    identity = lease.take("planner")
    assert lease.check(clock.time + 1.0) is None
    assert lease.check(clock.time + 1.001) == "planner"
    with pytest.raises(RefusalError, match="control was lost"):  # though its clock says otherwise
        lease.renew(identity)
    with pytest.raises(RefusalError, match="control was lost"), lease.used(identity):
        pytest.fail("a lost lease was used")


def test_nobody_gets_lost_control_before_the_arm_is_held(
    lease: ControlLease, clock: ManualClock
) -> None:
    lease.take("planner")
    clock.time += 2
    with pytest.raises(RefusalError, match="is being held"):  # also before `check` was called
        lease.take("other")
    assert lease.check(clock.time) == "planner"
    assert lease.check(clock.time) == "planner"  # until it is settled
    lease.settle()
    assert lease.check(clock.time) is None
    lease.take("other")


def test_settling_does_not_end_a_lease_that_is_not_lost(
    lease: ControlLease, clock: ManualClock
) -> None:
    identity = lease.take("planner")
    lease.settle()
    lease.renew(identity)


def test_a_command_counts_until_it_ends(lease: ControlLease, clock: ManualClock) -> None:
    identity = lease.take("planner")
    with lease.used(identity):
        clock.time += 5  # longer than the heartbeat: the loop plans
        assert lease.check(clock.time) is None
    clock.time += 0.9
    assert lease.check(clock.time) is None
    clock.time += 0.2
    assert lease.check(clock.time) == "planner"


def test_release_while_a_command_runs_ends_the_lease(lease: ControlLease) -> None:
    identity = lease.take("planner")
    with lease.used(identity):
        lease.release(identity)
    with pytest.raises(RefusalError, match="take it first"):
        lease.renew(identity)


def test_identities_that_are_no_text_of_ours_are_refused(lease: ControlLease) -> None:
    lease.take("planner")
    for made_up in ("", "é", "\U0001f512", "x" * 10_000):
        with pytest.raises(RefusalError):
            lease.release(made_up)
