"""A Zenoh router, as rmw_zenohd is one: whoever connects to it finds the others.

usage: python zenoh_router.py PORT
"""

from __future__ import annotations

import json
import sys

import zenoh


def main(port: int) -> None:
    """Route until standard input ends."""
    configuration = zenoh.Config()
    for key, value in {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
    }.items():
        configuration.insert_json5(key, json.dumps(value))
    with zenoh.open(configuration):
        print("ready", flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main(int(sys.argv[1]))
