"""When something was in a run, although the robot's wall clock was set meanwhile."""

import itertools

from holdfast.journal.run_clock import RunClock, Stamp, read_clocks

S = 1_000_000_000
NOW = 1_790_000_000 * S


def readings(boot: str, uptimes_s: range, wall_ns: int) -> list[tuple[Stamp | None, int]]:
    """Return a reading a second; the first one is at ``wall_ns``."""
    first = uptimes_s[0]
    return [(Stamp(boot, up * S), wall_ns + (up - first) * S) for up in uptimes_s]


def times(clock: RunClock, read: list[tuple[Stamp | None, int]]) -> list[int]:
    return [clock.time_ns(stamp, wall_ns) for stamp, wall_ns in read]


def test_a_clock_that_nobody_sets_is_followed() -> None:
    read = readings("a", range(50, 57), NOW)
    clock = RunClock(read)
    assert times(clock, read) == [NOW + each * S for each in range(7)]
    assert clock.notes == ()


def test_a_step_shifts_what_came_before() -> None:
    """By an hour, forwards or back, or from 1970: seven seconds stay seven seconds."""
    for before in (NOW - 3600 * S, NOW + 3600 * S, 5 * S):
        read = readings("a", range(50, 53), before) + readings("a", range(53, 58), NOW)
        clock = RunClock(read)
        assert times(clock, read) == [NOW + each * S for each in range(-3, 5)]
        (note,) = clock.notes
        seconds = (NOW - before) / S - 3
        assert f"was set by {seconds:+,.1f} s while it ran" in note


def test_a_slow_correction_is_no_step() -> None:
    read: list[tuple[Stamp | None, int]] = [
        (Stamp("a", up * S), NOW + up * (S + 500_000)) for up in range(100)
    ]
    clock = RunClock(read)
    assert clock.notes == ()
    found = times(clock, read)
    assert {later - earlier for earlier, later in itertools.pairwise(found)} == {S}


def test_between_two_boots_there_is_the_wall_clock() -> None:
    """A boot counts from 0 again; that of another machine perhaps from more."""
    for uptime in (3, 90_000):
        read = readings("a", range(50, 53), NOW)
        read += readings("b", range(uptime, uptime + 3), NOW + 60 * S)
        clock = RunClock(read)
        assert times(clock, read) == [wall_ns for _, wall_ns in read]
        assert clock.notes == ()


def test_a_boot_whose_clock_was_behind_comes_right_before_the_next() -> None:
    for before in (5 * S, NOW + 7200 * S):
        read = readings("a", range(50, 53), before) + readings("b", range(3), NOW)
        clock = RunClock(read)
        assert times(clock, read) == [NOW + each * S for each in (-3, -2, -1, 0, 1, 2)]
        assert "is not known" in clock.notes[0]


def test_what_an_older_run_or_a_damaged_line_lacks() -> None:
    clock = RunClock([(None, NOW), (None, NOW - S)])
    assert clock.time_ns(None, NOW) == NOW
    assert clock.time_ns(Stamp("a", 5), NOW) == NOW
    assert Stamp.of("a", "1.5") == Stamp("a", 1_500_000_000)
    for boot, uptime_s in ((None, "1"), ("a", "x"), ("a", None), ("a", "nan"), ("a", 1e30)):
        assert Stamp.of(boot, uptime_s) is None
    now_ns, stamp = read_clocks(lambda: NOW)
    assert now_ns == NOW
    again = Stamp.of(stamp.boot, stamp.uptime_s)
    assert again is not None
    assert 0 <= stamp.uptime_ns - again.uptime_ns < 1000
