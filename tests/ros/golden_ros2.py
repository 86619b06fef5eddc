"""Write what a real ROS 2 makes of our types: tests/unit/data/ros2 is its output.

It runs with the interpreter that tests/ros/set_up_ros2 installs, in the environment of the fixture
``ros2``::

    python tests/ros/golden_ros2.py tests/unit/data/ros2

The messages are serialised by rclpy, and the hashes come from the JSON files that rosidl has
generated; nothing of holdfast takes part.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

TYPES = ("holdfast_interfaces/srv/ActiveSensing", "std_srvs/srv/Trigger")


def hashes() -> dict[str, str]:
    """Return the hash of each type and of all that it is made of, by name."""
    found: dict[str, str] = {}
    prefixes = [Path(prefix) for prefix in os.environ["AMENT_PREFIX_PATH"].split(":")]
    for name in TYPES:
        package, kind, short = name.split("/")
        for prefix in prefixes:
            path = prefix / "share" / package / kind / f"{short}.json"
            if path.exists():
                described = json.loads(path.read_text())
                found |= {
                    each["type_name"]: each["hash_string"] for each in described["type_hashes"]
                }
    return dict(sorted(found.items()))


def messages() -> dict[str, Any]:
    """Return messages by the names of their files."""
    from holdfast_interfaces.msg import Belief, PlanningState
    from holdfast_interfaces.srv import ActiveSensing

    state = PlanningState(
        seed=2**53 + 1,
        trial=2**32 - 1,
        step=7,
        stage=2,
        sensed=True,
        belief=Belief(
            state_size=3,
            states=[0.5, -1.25, 3e-300, 4.0, 5.5, -0.0],
            weights=[0.25, 0.75],
        ),
    )
    return {
        "empty_request": ActiveSensing.Request(),
        "initialize_request": ActiveSensing.Request(
            kind=ActiveSensing.Request.INITIALIZE, configuration="0123456789abcdef", seed=5, trial=6
        ),
        "request": ActiveSensing.Request(
            kind=ActiveSensing.Request.CHOOSE_TASK_ACTIONS,
            configuration="ü",
            seed=-1,
            trial=3,
            state=state,
            sensing_action=4,
            observation=[1.5, 2.5, -3.5],
        ),
        "empty_answer": ActiveSensing.Response(),
        "refusal": ActiveSensing.Response(
            error=ActiveSensing.Response.BUSY, message="später", configuration="0123456789abcdef"
        ),
        "answer": ActiveSensing.Response(
            configuration="0123456789abcdef",
            state=state,
            sensing_action=9,
            entropies=[0.125, 1e300],
            action_size=2,
            task_actions=[1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
        ),
    }


def serialized(message: Any) -> bytes:
    """Return the bytes of a message that have a meaning.

    rclpy leaves in its padding whatever was there, and may return more bytes than it has written.
    Here padding is zero, and what ROS reads just as well without is left out.
    """
    from rclpy.serialization import deserialize_message, serialize_message

    data = bytearray(serialize_message(message))

    def is_same(changed: bytearray) -> bool:
        try:
            return bool(deserialize_message(bytes(changed), type(message)) == message)
        except Exception:  # noqa: BLE001 - whatever it raises, what was changed has a meaning
            return False

    while is_same(data[:-1]):
        del data[-1]
    for place in range(4, len(data)):
        changed = bytearray(data)
        # Two bits, since a text is the same with and without the zero at its end.
        for bit in (0x01, 0x80):
            changed[place] = data[place] ^ bit
            if not is_same(changed):
                break
        else:
            data[place] = 0
    return bytes(data)


def main(directory: Path) -> None:
    """Write all files."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "hashes.json").write_text(json.dumps(hashes(), indent=2) + "\n")
    for name, message in messages().items():
        (directory / f"{name}.cdr").write_bytes(serialized(message))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
