"""What a service remembers of each robot, and of sessions that it has forgotten."""

import math
from typing import Any

import msgspec
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.questions import received
from tests.unit.test_protocol_service import Bench, Robot, content, refused

from holdfast.problems.problem import Problem
from holdfast.protocol.computing_time import ExpectedTime
from holdfast.protocol.messages import Request, SessionConfiguration, encode
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import EndCall, Job, SendReply, ServiceEffect
from holdfast.protocol.service_limits import ServiceLimits
from holdfast.protocol.service_sessions import (
    CachedAnswer,
    ForgottenEpochs,
    PendingTask,
    Session,
    SessionTable,
)


def test_an_epoch_is_kept_until_its_session_is_held_again() -> None:
    epochs = ForgottenEpochs(4)
    epochs.note(("arm", b"1"), 3)
    epochs.note(("arm", b"1"), 5)
    assert epochs.get(("arm", b"1")) == 5
    assert epochs.get((None, b"1")) == 0
    epochs.forget(("arm", b"1"))
    assert epochs.get(("arm", b"1")) == 0
    assert list(epochs) == []
    assert not epochs._of
    # One that is noted again and again takes nobody's place.
    epochs.note(("arm", b"2"), 1)
    for _ in range(9):
        epochs.note(("arm", b"1"), 3)
    assert epochs.get(("arm", b"2")) == 1


def test_the_owner_with_the_most_loses_its_oldest() -> None:
    epochs = ForgottenEpochs(3)
    epochs.note(("small", b"0"), 7)
    for number in range(3):
        epochs.note(("large", bytes([number])), 1)
    assert list(epochs) == [("small", b"0"), ("large", b"\1"), ("large", b"\2")]


OWNERS = ("anna", "berta", None)


def test_an_owners_replaced_process_stays_replaced() -> None:
    bench, robot = Bench(), Robot()
    bench.ask(robot.request(epoch=2), "anna")
    assert refused(bench.ask(robot.request(), "anna")).code == "stale_epoch"
    bench.apply(bench.service.tick(bench.now + 10_000.0))
    assert refused(bench.ask(robot.request(), "anna")).code == "stale_epoch"


def test_notes_name_the_robot_that_has_a_certificate() -> None:
    bench = Bench()
    bench.ask(Robot().request(), "anna")
    bench.ask(Robot().request())
    opened = [note.fields.get("robot") for note in bench.notes if note.name == "session_opened"]
    assert opened == ["anna", None]


class TestEpochMemory:
    def test_one_owner_cannot_make_the_others_forgotten(self) -> None:
        bench, robot = Bench(max_sessions=4), Robot(key=1)
        bench.ask(robot.request(epoch=5), "berta")
        bench.apply(bench.service.tick(bench.now + 10_000.0))
        sessions = bench.service._sessions
        for number in range(20_000):
            sessions.note_epoch(("anna", number.to_bytes(16, "big")), 1)
        assert refused(bench.ask(robot.request(), "berta")).code == "stale_epoch"
        assert sessions.epoch_of(("anna", (0).to_bytes(16, "big"))) == 0
        assert sessions.epoch_of(("anna", (19_999).to_bytes(16, "big"))) == 1


class TestTurns:
    def test_many_sessions_of_one_owner_have_one_turn(self) -> None:
        bench = Bench(max_wait_ms=1e9)
        order = [bench.send(Robot(key=100 + n).request(), "anna") for n in range(12)]
        mine = bench.send(Robot(key=1).request(), "berta")
        bench.run_all()
        ended = [call for name, call in bench.trace if name == "SensingAnswer"]
        # Anna's first is in work, and her next was there before.
        assert ended.index(mine) <= 2
        assert sorted(ended) == sorted([*order, mine])
        assert [call for call in ended if call != mine] == order, "her own as they came"


class TestRoom:
    def test_one_owner_does_not_push_out_another(self) -> None:
        bench, berta = Bench(max_sessions=6), Robot(key=1)
        bench.ask(berta.request(), "berta")
        for number in range(30):
            bench.ask(Robot(key=100 + number).request(), "anna")
        assert bench.service.statistics.sessions == 6
        berta.sense()
        assert (
            content(bench.ask(berta.request(session_configuration=False), "berta"))
            == berta.right_answer()
        )

    def test_most_sessions_of_one_robot_that_are_all_in_use(self) -> None:
        bench = Bench(max_sessions_per_robot=2, max_wait_ms=1e9)
        calls = [bench.send(Robot(key=100 + number).request(), "anna") for number in range(3)]
        assert [bench.kinds(call) for call in calls] == [[], [], ["Busy"]]
        assert bench.kinds(bench.send(Robot(key=1).request(), "berta")) == []


class _Split:
    """A service with a worker for each job, so that nobody waits; answers by whose they are."""

    def __init__(self) -> None:
        self.service = Service(_problem, 1000, ServiceLimits())
        self.jobs: dict[str | None, list[Job]] = {owner: [] for owner in OWNERS}
        self.replies: dict[str | None, list[tuple[int, bytes | None]]] = {
            owner: [] for owner in OWNERS
        }
        self._calls: dict[int, tuple[str | None, int]] = {}

    def send(self, owner: str | None, number: int, payload: bytes) -> None:
        call = len(self._calls)
        self._calls[call] = owner, number
        self._apply(owner, self.service.receive(call, *received(payload), 0.0, owner))

    def run(self, owner: str | None) -> None:
        if self.jobs[owner]:
            job = self.jobs[owner].pop(0)
            self._apply(owner, self.service.finished(job, job.run(), 0.0))

    def _apply(self, owner: str | None, effects: list[ServiceEffect]) -> None:
        for effect in (*effects, *self.service.next_jobs(0.0)):
            if isinstance(effect, Job):
                self.jobs[owner].append(effect)
            elif isinstance(effect, SendReply | EndCall):
                whose, number = self._calls[effect.call]
                assert whose == owner, "what one owner does tells another something"
                payload = effect.payload if isinstance(effect, SendReply) else None
                self.replies[owner].append((number, payload))


def _problem(session_configuration: SessionConfiguration) -> Problem:
    return _ROBOT.problem


_ROBOT = Robot()


def _turns() -> list[Robot]:
    """Return a robot at several moments of its trial."""
    robots = []
    for count in range(4):
        robot = Robot()
        for _ in range(count):
            robot.act_until_sensing()
            robot.sense()
        robots.append(robot)
    return robots


_MOMENTS = _turns()

ACTIONS = st.tuples(
    st.sampled_from(OWNERS),
    st.one_of(
        st.none(),
        st.tuples(
            st.sampled_from(range(len(_MOMENTS))),
            st.sampled_from([1, 2, 3]),  # epochs
            st.sampled_from([1, 2, 3, 9]),  # numbers
            st.booleans(),  # with the opening
            st.booleans(),  # with the state
        ),
    ),
)


def _request(what: tuple[int, int, int, bool, bool]) -> Request:
    moment, epoch, number, session_configuration, state = what
    robot = _MOMENTS[moment]
    changes: dict[str, Any] = {
        "epoch": epoch,
        "number": number,
        "session_configuration": robot.session_configuration if session_configuration else None,
    }
    return robot.restore(**changes) if state else robot.request(**changes)


@given(st.lists(ACTIONS, max_size=40))
@settings(max_examples=150)
def test_each_owner_is_answered_as_if_it_were_alone(
    actions: list[tuple[str | None, tuple[int, int, int, bool, bool] | None]],
) -> None:
    """The same session, epochs and numbers: byte for byte the same replies in the same order."""
    together = _Split()
    alone = {owner: _Split() for owner in OWNERS}
    for count, (owner, what) in enumerate(actions):
        for service in (together, alone[owner]):
            if what is None:
                service.run(owner)
            else:
                service.send(owner, count, encode(_request(what)))
    for owner in OWNERS:
        for service in (together, alone[owner]):
            while service.jobs[owner]:
                service.run(owner)
        assert together.replies[owner] == alone[owner].replies[owner]


def session_of(number: int, owner: str | None = "anna") -> Session:
    robot = Robot(key=number)
    request = robot.request()
    return Session(
        (owner, request.session),
        request,
        robot.session_configuration,
        (ExpectedTime(), ExpectedTime()),
    )


class TestTheTable:
    def table(self, **limits: Any) -> SessionTable:
        return SessionTable(ServiceLimits(**limits))

    def test_an_epoch_outlives_its_session_and_no_other(self) -> None:
        table, session = self.table(), session_of(1)
        assert table.epoch_of(session.key) == 0
        session.epoch = 7
        table.add(session)
        assert table.epoch_of(session.key) == 7
        session.epoch = 8
        table.forget(session)
        assert session.closed
        assert len(table) == 0
        assert table.epoch_of(session.key) == 8
        assert table.epoch_of((None, session.key[1])) == 0
        again = session_of(1)
        again.epoch = 9
        table.add(again)
        assert table.epoch_of(session.key) == 9
        assert list(table._epochs) == []

    def test_forgotten_epochs_are_kept_for_four_times_the_sessions(self) -> None:
        for most, kept in ((10, 4096), (1025, 4100)):
            assert self.table(max_sessions=most)._epochs._most == kept

    def test_once_served_is_served(self) -> None:
        table = self.table()
        first, second = (session_of(number) for number in range(2))
        for session in (first, second):
            table.add(session)
        for _ in range(2):
            table.mark_served(first)
        assert (first.served, second.served) == (True, False)
        assert table._num_unserved == 1

    def test_when_there_is_room(self) -> None:
        sessions = [session_of(number) for number in range(4)]
        size = len(sessions[0].configuration)
        others = [session_of(number, "berta") for number in range(4)]
        for limits, fit in (
            ({"max_sessions": 3}, [3, 0]),
            ({"max_sessions_per_robot": 2}, [2, 2]),
            ({"max_configuration_bytes": 3 * size}, [3, 0]),
            ({"max_configuration_bytes": 3 * size - 1}, [2, 0]),
            ({"max_configuration_bytes": 1}, [1, 0]),  # the only one always fits
        ):
            table = self.table(**limits)
            for each, most in ((sessions, fit[0]), (others, fit[1])):
                for number, session in enumerate(each):
                    fits = table.has_room_for(session)
                    assert fits == (number < most), limits
                    if fits:
                        table.add(session)
        table = self.table(max_sessions_per_robot=1)
        for session in (session_of(1, None), session_of(2, None)):
            assert table.has_room_for(session)  # those without a certificate are many
            table.add(session)

    def test_who_makes_room(self) -> None:
        """The one used longest ago, of those that hold at least half of the largest holding."""
        table = self.table(max_sessions=7)
        annas = [session_of(number) for number in range(4)]
        bertas = [session_of(number, "berta") for number in range(2)]
        carl = session_of(1, "carl")
        for session in (carl, *bertas, *annas):
            table.add(session)
            table.mark_served(session)
        new = session_of(9, "dora")
        assert table.evictable_for(new) is bertas[0]
        table.use(bertas[0], 1.0)
        assert table.evictable_for(new) is bertas[1]
        for session in bertas:
            session.pending[b""] = task_of(session)
        assert table.evictable_for(new) is annas[0]
        for session in annas:
            session.pending[b""] = task_of(session)
        assert table.evictable_for(new) is carl  # all of those have tasks
        carl.pending[b""] = task_of(carl)
        assert table.evictable_for(new) is None

    def test_what_was_never_served_makes_room_once_it_fills_half(self) -> None:
        table = self.table(max_sessions=4)
        sessions = [session_of(number) for number in range(4)]
        for session in sessions:
            table.add(session)
        for session in sessions[:3]:
            table.mark_served(session)
        assert table.evictable_for(session_of(9)) is sessions[0]
        table.forget(sessions[2])
        table.add(sessions[2])  # two of four: it counts as served already
        assert table.evictable_for(session_of(9)) is sessions[0]
        unserved = session_of(5)
        table.forget(sessions[1])
        table.add(unserved)
        assert table.evictable_for(session_of(9)) is sessions[3]

    def test_of_one_that_has_its_most_its_own_goes(self) -> None:
        table = self.table(max_sessions_per_robot=2)
        berta = session_of(0, "berta")
        annas = [session_of(number) for number in range(2)]
        for session in (berta, *annas):
            table.add(session)
        assert table.evictable_for(session_of(9)) is annas[0]

    def test_bytes_are_counted_and_given_back(self) -> None:
        table = self.table(max_state_bytes=100)
        sessions = [session_of(number, owner) for number, owner in ((1, "anna"), (2, "berta"))]
        for session in sessions:
            table.add(session)
            session.answers[b"1"] = CachedAnswer(0, 0, True, 1, actions=b"x" * 50)
            table.update_size(session)
            table.update_size(session)
        assert (table.state_bytes, table.over_budget) == (100, False)
        sessions[0].answers[b"2"] = CachedAnswer(0, 0, True, 1, actions=b"x")
        table.update_size(sessions[0])
        assert (table.state_bytes, table.over_budget) == (101, True)
        assert table.largest_evictable() is sessions[0]
        table.drop_states(sessions[0])
        assert sessions[0].answers == {}
        assert table.state_bytes == 50
        table.forget(sessions[1])
        assert table.state_bytes == 0
        assert table.configuration_bytes == len(sessions[0].configuration)
        assert set(table._num_of) == {"anna"}

    def test_what_was_not_used_for_long(self) -> None:
        table = self.table(max_idle_s=10.0)
        assert (table.idle(1e9), table.idle_at()) == (None, None)
        first, second = session_of(1), session_of(2)
        for number, session in enumerate((first, second)):
            table.add(session)
            table.use(session, float(number))
        assert table.idle_at() == 10.0
        assert table.idle(9.99) is None
        assert table.idle(10.0) is first
        table.use(first, 5.0)
        assert table.idle(11.0) is second
        second.pending[b""] = task_of(second)
        assert table.idle(99.0) is None


def task_of(session: Session) -> PendingTask:
    return PendingTask(session, b"", sensing=True, request=None, state=None, size=0, since=0.0)


def test_cached_answers_are_bounded_and_the_newest_stay() -> None:
    session = session_of(1)
    answers = [CachedAnswer(0, 0, True, 1, actions=bytes(number)) for number in range(4)]
    for number in (0, 1, 2, 0, 3):
        session.remember(b"%d" % number, answers[number], 3)
    assert list(session.answers) == [b"2", b"0", b"3"]
    assert session.size() == 2 + 0 + 3


def test_a_task_whose_place_was_taken_removes_nothing() -> None:
    session = session_of(1)
    old, new = task_of(session), task_of(session)
    session.pending[b""] = new
    session.remove_task(old)
    assert session.pending == {b"": new}
    session.remove_task(new)
    assert session.pending == {}


def test_the_nearest_state_before_a_request() -> None:
    robot = Robot(key=1)
    request = robot.request()
    session = session_of(1)
    state = robot.state
    assert session.state_before(request) is None
    assert not session.states_of(state.trial)
    session.acknowledged = state._replace(step=request.step, sensed=request.sensed)
    assert session.state_before(request) is session.acknowledged
    session.ahead = state._replace(step=request.step + 1, sensed=False)
    assert session.state_before(request) is session.acknowledged
    session.ahead = state._replace(step=request.step, sensed=request.sensed)
    assert session.state_before(request) is session.ahead
    session.ahead = session.ahead._replace(trial=state.trial + 1)
    assert session.state_before(request) is session.acknowledged
    assert session.states_of(state.trial + 1)
    assert not session.states_of(state.trial + 2)
    session.acknowledged = state._replace(step=request.step, sensed=not request.sensed)
    assert (session.state_before(request) is None) == (not request.sensed)


def test_which_tasks_earlier_times_predict() -> None:
    session = session_of(1)
    session.built_in = session.served = True
    for time in session.times:
        time.learn(0.001)
    interval = session.planning.sensing_interval
    robot = Robot(key=1)
    robot.sense()
    request = msgspec.structs.replace(robot.request(), step=32, checkpoint=None)
    one = request.inputs[:1]
    assert len(one) == 1

    def typical(request: Request | None, state: int | None = None, *, sensing: bool = True) -> bool:
        task = PendingTask(
            session, b"", sensing=sensing, request=request, state=None, size=0, since=0.0
        )
        session.acknowledged = None if state is None else robot.state._replace(step=state)
        return task.predicted_s(task.starts_at()) < math.inf

    request = msgspec.structs.replace(request, inputs=one)
    assert typical(request)
    assert typical(None)
    assert not typical(msgspec.structs.replace(request, inputs=one * 2))
    assert not typical(msgspec.structs.replace(request, checkpoint=b"state"))
    later = msgspec.structs.replace(request, step=33)
    assert not typical(later)
    assert typical(later, state=1)
    assert not typical(later, state=interval, sensing=False)
    assert typical(later, state=1 + interval, sensing=False)
    session.built_in = False
    assert not typical(None)
