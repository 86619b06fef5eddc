"""What the last release promised still holds: its public names, its calls, and its wire.

``api.json`` has the public names of ``import holdfast as hf`` with their parameters, as released; a
name may be added, a parameter too if it has a default, but none may go before
:mod:`holdfast.earlier_names` has said so for a release. ``wire.txt`` is a robot's talk (``>``) with
a service (``<``), recorded; a service of today must read it and answer the same, byte for byte. ::

    python -m tests.golden.test_released

records both anew: once, as the last change before a release, or with a new ``PROTOCOL_VERSION``.
"""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import msgspec
from tests.questions import request_of
from tests.unit.test_protocol_service import Bench, make_problem, planning_of

import holdfast as hf
from holdfast.planning.inputs import Sensed, encode_floats
from holdfast.planning.planner import Planner, encode_checkpoint
from holdfast.protocol.messages import (
    NeedState,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
    decode_reply,
    encode,
)
from holdfast.robot.environment import SimulatedEnvironment

API = Path(__file__).with_name("api.json")
WIRE = Path(__file__).with_name("wire.txt")
ATTRIBUTE = "attribute"


def parameters(function: Any) -> str:
    """Return what a caller can write: ``a, b=, *, c=``, a sign of equality for each default."""
    words, star = [], False
    for name, each in inspect.signature(function).parameters.items():
        if each.kind is each.KEYWORD_ONLY and not star:
            words.append("*")
        star |= each.kind in (each.KEYWORD_ONLY, each.VAR_POSITIONAL)
        mark = {"VAR_POSITIONAL": "*", "VAR_KEYWORD": "**"}.get(each.kind.name, "")
        words.append(f"{mark}{name}{'' if each.default is each.empty else '='}")
    return ", ".join(words)


def members_of(place: str, value: Any) -> dict[str, str]:
    """Return a name with what is public in it: of a module, or of a class that is no exception."""
    if inspect.isroutine(value):
        return {place: parameters(value)}
    is_module = inspect.ismodule(value)
    if not is_module and (not inspect.isclass(value) or issubclass(value, Exception)):
        return {place: ATTRIBUTE}
    found = {}
    if is_module:
        names = getattr(value, "__all__", [name for name in vars(value) if "Error" in name])
    else:
        names = {*vars(value), *inspect.get_annotations(value)}
        found[place] = ATTRIBUTE if getattr(value, "_is_protocol", False) else parameters(value)
    for name in sorted(name for name in names if not name.startswith("_")):
        member = getattr(value, name, None)
        found |= members_of(f"{place}.{name}", None if inspect.isclass(member) else member)
    return found


def public_names() -> dict[str, str]:
    return {
        name: shape
        for each in hf.__all__
        for name, shape in members_of(each, getattr(hf, each)).items()
    }


def broken(name: str, before: str, now: str | None) -> list[str]:
    """Return what a program that was written for the parameters of before trips over."""
    if now is None or (before == ATTRIBUTE) != (now == ATTRIBUTE):
        return [f"{name} is no longer there" if now is None else f"{name} was {before}, is {now}"]
    if before == ATTRIBUTE:
        return []
    old, new = ([*filter(None, text.split(", "))] for text in (before, now))
    old_positional, new_positional = (
        [word.rstrip("=") for word in (each[: each.index("*")] if "*" in each else each)]
        for each in (old, new)
    )
    found = []
    if new_positional[: len(old_positional)] != old_positional:
        found.append(f"{name}({now}): was called by position as ({before})")
    old_default, new_default = (
        {word.rstrip("="): word[-1] for word in each} for each in (old, new)
    )
    found += [f"{name}: no parameter {word}" for word in old_default if word not in new_default]
    needed = {word for word, last in new_default.items() if last != "=" and word[0] != "*"}
    were = {word for word, last in old_default.items() if last != "="}
    return found + [f"{name}: {word} must be given now" for word in sorted(needed - were)]


def test_programs_of_the_last_release_still_run() -> None:
    released, now = json.loads(API.read_text(encoding="utf-8")), public_names()
    assert not [each for name, as_ in released.items() for each in broken(name, as_, now.get(name))]
    # It finds what goes, moves, or must be given, and lets pass what is added.
    assert not broken("f", "a, b=, *, c=", "a, b=, more=, *, c=, d=")
    assert len(broken("f", "a, b=, *, c=", "b, a, *, d")) == 4
    assert broken("f", "a", None) == ["f is no longer there"]


def requests() -> list[bytes]:
    """Return what a robot sends: of a session that is not known, then with all that is needed."""
    session, planning = b"recorded session", planning_of()
    about = SessionConfiguration("peg_in_hole_2d", {}, {}, planning, 9)
    problem = make_problem(about)
    planner, world = Planner(problem, planning), SimulatedEnvironment(problem, 9, 0)
    state = planner.init(9, 0)
    found = [request_of(state, session, 1)]
    found.append(request_of(state, session, 2, session_configuration=about))
    for number in (3, 4):
        while not planner.needs_sensing(state):
            action, _ = planner.choose_task_action(state)
            world.perform(action)
            state = planner.advance(state, action)
        sensing, _ = planner.choose_sensing_action(state)
        shown = world.perform_sensing(sensing)
        observed = Sensed(state.step, sensing, encode_floats(shown))
        state, _ = planner.observe(state, sensing, shown)
        found.append(request_of(state, session, number, inputs=(observed,)))
    found.append(
        request_of(
            state,
            b"another session.",
            5,
            session_configuration=about,
            checkpoint=encode_checkpoint(state),
        )
    )
    return [encode(each) for each in found]


def as_recorded(sent: list[bytes]) -> str:
    """Return the requests and what a service of today replies to each, but how long it took."""
    bench, lines = Bench(), []
    for request in sent:
        call = bench.send(request)
        while bench.jobs:
            bench.run()
        lines.append(f"> {request.hex()}")
        for reply in bench.replies[call]:
            timeless = {"computed_us": 0} if hasattr(reply, "computed_us") else {}
            lines.append(f"< {encode(msgspec.structs.replace(reply, **timeless)).hex()}")
    return "\n".join(lines) + "\n"


def test_robots_and_services_of_the_last_release_are_understood() -> None:
    text = WIRE.read_text(encoding="ascii")
    messages = [(line[0], bytes.fromhex(line[2:])) for line in text.splitlines()]
    sent = [payload for end, payload in messages if end == ">"]
    assert as_recorded(sent) == text
    assert requests() == sent
    kinds = [type(decode_reply(payload)) for end, payload in messages if end == "<"]
    assert {NeedState, TaskAnswer, SensingAnswer} <= set(kinds)


if __name__ == "__main__":
    API.write_text(json.dumps(public_names(), indent=0, sort_keys=True) + "\n", encoding="utf-8")
    WIRE.write_text(as_recorded(requests()), encoding="ascii")
