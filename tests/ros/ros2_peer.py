"""Another process of ROS 2 for the tests: it does what it reads, and says what it has seen.

It reads a line of JSON at a time on its standard input and answers each with one on its standard
output. It may also be the world: then it asks the node's ``~/decide`` for decisions and performs
them in a simulated world.
"""

from __future__ import annotations

import json
import sys
import threading
from time import monotonic, perf_counter, sleep
from typing import Any

import bond.msg
import diagnostic_msgs.msg
import geometry_msgs.msg
import holdfast_interfaces.action
import holdfast_interfaces.msg
import holdfast_interfaces.srv
import lifecycle_msgs.srv
import rcl_interfaces.msg
import rcl_interfaces.srv
import rclpy
import std_msgs.msg
import tf2_msgs.msg
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from holdfast.config.loader import load
from holdfast.robot.environment import SimulatedEnvironment

Decide = holdfast_interfaces.srv.Decide
Run = holdfast_interfaces.action.Run

CODES = {
    value: name
    for name, value in (
        (name, getattr(Decide.Response, name))
        for name in ("OK", "HOLDING", "FINISHED", "BAD_REQUEST", "INACTIVE", "ENDED")
    )
}
RUN_CODES = ("FINISHED", "PAUSED", "HELD", "FAILED", "REFUSED")

TRANSITIONS = {
    "configure": 1,
    "cleanup": 2,
    "activate": 3,
    "deactivate": 4,
    "unconfigured_shutdown": 5,
    "inactive_shutdown": 6,
    "active_shutdown": 7,
}


class Peer:
    """A node, with what it has seen."""

    def __init__(self, name: str) -> None:
        self.node = rclpy.create_node("peer")
        self.seen: dict[str, list[Any]] = {
            topic: []
            for topic in (
                *("clouds", "beliefs", "decisions", "statuses", "diagnostics", "feedback"),
                *("frames", "bonds"),
            )
        }
        self.last: dict[str, Any] = {}
        best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
        deep = QoSProfile(depth=1000)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, kind, key, quality in (
            (f"{name}/particle_cloud", geometry_msgs.msg.PoseArray, "clouds", best_effort),
            (f"{name}/belief", std_msgs.msg.Float64MultiArray, "beliefs", best_effort),
            (f"{name}/decision", holdfast_interfaces.msg.Decision, "decisions", deep),
            (f"{name}/status", std_msgs.msg.String, "statuses", deep),
            ("/diagnostics", diagnostic_msgs.msg.DiagnosticArray, "diagnostics", deep),
            ("/tf_static", tf2_msgs.msg.TFMessage, "frames", latched),
            (f"{name.rpartition('/')[0]}/bond", bond.msg.Status, "bonds", deep),
        ):
            self.node.create_subscription(kind, topic, self.taker(key), quality)
        self.decider = self.node.create_client(Decide, f"{name}/decide")
        self.runner = ActionClient(self.node, Run, f"{name}/run")
        self.changer = self.node.create_client(
            lifecycle_msgs.srv.ChangeState, f"{name}/change_state"
        )
        self.getter = self.node.create_client(lifecycle_msgs.srv.GetState, f"{name}/get_state")
        self.setter = self.node.create_client(
            rcl_interfaces.srv.SetParameters, f"{name}/set_parameters"
        )
        self.getter_of_parameters = self.node.create_client(
            rcl_interfaces.srv.GetParameters, f"{name}/get_parameters"
        )
        self.goal: Any = None
        self.outcome: Any = None
        self.worlds: dict[int, SimulatedEnvironment] = {}
        self.call = Decide.Request()
        self.performed: tuple[int, int] | None = None
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        threading.Thread(target=self.executor.spin, daemon=True).start()

    def taker(self, key: str) -> Any:
        def take(message: Any) -> None:
            self.last[key] = message
            self.seen[key].append(self.brief(key, message))

        return take

    @staticmethod
    def brief(key: str, message: Any) -> Any:
        if key == "clouds":
            return [message.header.frame_id, len(message.poses)]
        if key == "beliefs":
            return [[dimension.label, dimension.size] for dimension in message.layout.dim]
        if key == "frames":
            (transform,) = message.transforms
            turn = transform.transform.rotation
            return [
                *(transform.header.frame_id, transform.child_frame_id),
                *(turn.x, turn.y, turn.z, turn.w),
            ]
        if key == "bonds":
            return [message.id, message.instance_id, message.active, message.heartbeat_period]
        if key in ("decisions", "feedback"):
            if key == "feedback":
                message = message.feedback.decision
            return [
                message.trial,
                message.step,
                message.kind,
                message.sensing_action,
                list(message.entropies),
                list(message.task_action),
                message.status,
                message.decided_by,
            ]
        if key == "statuses":
            return message.data
        (status,) = message.status
        return [
            status.level[0],
            status.message,
            {item.key: item.value for item in status.values},
            status.name,
            status.hardware_id,
        ]

    def wait(self, future: Any, within_s: float) -> Any:
        deadline = monotonic() + within_s
        while not future.done() and monotonic() < deadline:
            sleep(0.0002)
        if not future.done():
            raise TimeoutError(f"no answer within {within_s} s")
        return future.result()

    def ask(self, client: Any, request: Any, within_s: float) -> Any:
        """Ask until there is an answer: a node that was just started may not be known yet."""
        deadline = monotonic() + within_s
        while True:
            future = client.call_async(request)
            try:
                return self.wait(future, min(2.0, within_s))
            except TimeoutError:
                client.remove_pending_request(future)
                if monotonic() > deadline:
                    raise

    # -- commands --------------------------------------------------------------------------------

    def do_change(self, transition: str, within_s: float = 60.0) -> bool:
        if not self.changer.wait_for_service(within_s):
            raise TimeoutError("there is no change_state")
        request = lifecycle_msgs.srv.ChangeState.Request()
        request.transition.id = TRANSITIONS[transition]
        return bool(self.wait(self.changer.call_async(request), within_s).success)

    def do_state(self) -> str:
        answer = self.ask(self.getter, lifecycle_msgs.srv.GetState.Request(), 30.0)
        return str(answer.current_state.label)

    def do_set(self, **values: Any) -> list[Any]:
        request = rcl_interfaces.srv.SetParameters.Request(
            parameters=[
                rclpy.parameter.Parameter(name, value=value).to_parameter_msg()
                for name, value in values.items()
            ]
        )
        answer = self.ask(self.setter, request, 30.0)
        return [[result.successful, result.reason] for result in answer.results]

    def do_get(self, names: list[str]) -> list[Any]:
        request = rcl_interfaces.srv.GetParameters.Request(names=names)
        answer = self.ask(self.getter_of_parameters, request, 30.0)
        values = [rclpy.parameter.parameter_value_to_python(value) for value in answer.values]
        return [list(value) if hasattr(value, "typecode") else value for value in values]

    def do_goal(self, within_s: float = 60.0) -> bool:
        if not self.runner.wait_for_server(within_s):
            raise TimeoutError("there is no action server")
        take = self.taker("feedback")
        deadline = monotonic() + within_s
        while True:
            # One that was killed is still known for a while: what is sent to it has no answer.
            try:
                goal = self.wait(self.runner.send_goal_async(Run.Goal(), take), 5.0)
                break
            except TimeoutError:
                if monotonic() > deadline:
                    raise
        if goal.accepted:
            self.goal = goal
            self.outcome = goal.get_result_async()
        return bool(goal.accepted)

    def do_second_goal(self, within_s: float = 60.0) -> Any:
        goal = self.wait(self.runner.send_goal_async(Run.Goal()), within_s)
        if not goal.accepted:
            return "rejected"
        return self.told(self.wait(goal.get_result_async(), within_s))

    def do_cancel(self, within_s: float = 60.0) -> int:
        return len(self.wait(self.goal.cancel_goal_async(), within_s).goals_canceling)

    def do_result(self, within_s: float = 120.0) -> Any:
        return self.told(self.wait(self.outcome, within_s))

    @staticmethod
    def told(wrapped: Any) -> dict[str, Any]:
        result = wrapped.result
        return {
            "status": wrapped.status,
            "code": RUN_CODES[result.code],
            "message": result.message,
            "trials": [
                [trial.trial, trial.outcome, trial.steps, trial.digest] for trial in result.trials
            ],
        }

    def do_decide(self, within_s: float = 30.0, **fields: Any) -> dict[str, Any]:
        answer = self.ask(self.decider, Decide.Request(**fields), within_s)
        return {
            "code": CODES[answer.code],
            "message": answer.message,
            "trial": answer.trial,
            "number": answer.number,
            "step": answer.step,
            "kind": answer.kind,
            "sensing_action": answer.sensing_action,
            "task_action": list(answer.task_action),
            "status": answer.status,
        }

    def do_drive(
        self, configuration: str, seed: int, answers: int = 1_000_000, within_s: float = 200.0
    ) -> dict[str, Any]:
        """Be the world and its executive until so many decisions are performed, or all."""
        problem = load(configuration, seed=seed).problem
        deadline = monotonic() + within_s
        count = 0
        times: list[float] = []
        again = 0
        while count < answers:
            if monotonic() > deadline:
                raise TimeoutError(f"not done within {within_s} s; {count} decisions")
            began = perf_counter()
            future = self.decider.call_async(self.call)
            try:
                answer = self.wait(future, 3.0)
            except TimeoutError:
                self.decider.remove_pending_request(future)
                again += 1
                continue
            code = CODES[answer.code]
            if code == "FINISHED":
                break
            if code in ("HOLDING", "ENDED", "INACTIVE"):
                again += 1
                if code != "HOLDING":
                    sleep(0.05)
                continue
            if code != "OK":
                raise RuntimeError(f"{code}: {answer.message}")
            times.append(perf_counter() - began)
            if self.performed == (answer.trial, answer.number):
                raise RuntimeError(f"number {answer.number} came twice for different calls")
            self.performed = (answer.trial, answer.number)
            count += 1
            world = self.worlds.setdefault(
                answer.trial, SimulatedEnvironment(problem, seed, answer.trial)
            )
            call = Decide.Request(trial=answer.trial, number=answer.number)
            if answer.kind == Decide.Response.SENSE:
                call.observation = list(world.perform_sensing(answer.sensing_action))
            else:
                import numpy as np

                reward = world.perform(np.array(answer.task_action))
                call.has_reward = reward is not None
                call.reward = reward or 0.0
                call.done = Decide.Request.SUCCEEDED if world.is_done() else 0
            self.call = call
        return {"performed": count, "again": again, "times": times}

    def do_seen(self) -> dict[str, Any]:
        seen, self.seen = self.seen, {key: [] for key in self.seen}
        return seen

    def do_cloud(self) -> Any:
        message = self.last["clouds"]
        return [
            [
                pose.position.x,
                pose.position.y,
                pose.position.z,
                pose.orientation.x,
                pose.orientation.y,
                pose.orientation.z,
                pose.orientation.w,
            ]
            for pose in message.poses
        ]

    def do_belief(self) -> Any:
        message = self.last["beliefs"]
        rows, columns = message.layout.dim
        return {"rows": rows.size, "columns": columns.label, "data": list(message.data)}


def main() -> None:
    rclpy.init()
    peer = Peer(sys.argv[1])
    sys.stdout.write('{"ready": true}\n')
    sys.stdout.flush()
    for line in sys.stdin:
        command = json.loads(line)
        name = command.pop("do")
        try:
            answer = {"answer": getattr(peer, f"do_{name}")(**command)}
        except Exception as error:  # noqa: BLE001 - the test says what it means
            answer = {"error": f"{type(error).__name__}: {error}"}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
