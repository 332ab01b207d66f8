"""A real rclpy node, told what to do by lines of JSON; runs in a ROS 2 environment, and imports nothing of SERN.

`rclpy_node.py DOMAIN NAME [--ros-args ...]`. Each line of input is `{"do": ..., "id": ...}`; it is answered with
`{"id": ..., ...}`. What happens meanwhile is `{"event": ..., ...}`. Messages are told as Python writes them: equal text
is equal value.
"""

# mypy: ignore-errors
# It runs among the packages of ROS, whose types are not known where it is checked.

import contextlib
import importlib
import json
import sys
import threading
import time

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

lock = threading.Lock()


def say(**what):
    with lock:
        print(json.dumps(what), flush=True)


def load(type_name):
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def profile(said):
    return QoSProfile(
        depth=said.get("depth", 10),
        reliability=ReliabilityPolicy.BEST_EFFORT if said.get("best_effort") else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if said.get("latched") else DurabilityPolicy.VOLATILE,
    )


class Peer:
    def __init__(self, node):
        self.node = node
        self.group = ReentrantCallbackGroup()
        self.publishers = {}
        self.clients = {}
        self.actions = {}
        self.goals = {}
        self.kept = []
        self.served = 0

    def pub(self, said):
        self.publishers[said["topic"]] = self.node.create_publisher(load(said["type"]), said["topic"], profile(said))

    def unpub(self, said):
        self.node.destroy_publisher(self.publishers.pop(said["topic"]))

    def write(self, said):
        """A body in hex, as CDR; read and written again by rclpy, so that what is sent is its own."""
        publisher = self.publishers[said["topic"]]
        message = deserialize_message(bytes.fromhex(said["body"]), publisher.msg_type)
        publisher.publish(message)
        return {"value": str(message)}

    def write_raw(self, said):
        self.publishers[said["topic"]].publish(bytes.fromhex(said["body"]))

    def sub(self, said):
        """With `sized` it tells of each message how much data it has, and nothing else."""
        topic, sized = said["topic"], said.get("sized")
        self.kept.append(
            self.node.create_subscription(
                load(said["type"]),
                topic,
                lambda message: say(event="got", topic=topic, value=len(message.data) if sized else str(message)),
                profile(said),
            )
        )

    def count(self, said):
        return {
            "publishers": self.node.count_publishers(said["topic"]),
            "subscribers": self.node.count_subscribers(said["topic"]),
        }

    def nodes(self, said):
        return {
            "names": [
                namespace.rstrip("/") + "/" + name for name, namespace in self.node.get_node_names_and_namespaces()
            ]
        }

    def matched(self, said):
        return {"count": self.publishers[said["topic"]].get_subscription_count()}

    def serve(self, said):
        """SetBool: success is the request, the message counts calls. One with `silent` sleeps past every deadline."""

        def answer(request, response):
            self.served += 1
            say(event="asked", service=said["service"], data=request.data)
            response.success = request.data
            response.message = f"call {self.served}"
            return response

        kind = load("std_srvs/srv/SetBool")
        self.kept.append(self.node.create_service(kind, said["service"], answer, callback_group=self.group))

    def call(self, said):
        kind = load("std_srvs/srv/SetBool")
        name = said["service"]
        client = self.clients.get(name)
        if client is None:
            client = self.clients[name] = self.node.create_client(kind, name, callback_group=self.group)
        assert client.wait_for_service(60), "no such service"
        request = kind.Request()
        request.data = said["data"]
        future = client.call_async(request)
        future.add_done_callback(
            lambda done: say(
                event="answered", key=said["key"], success=done.result().success, text=done.result().message
            )
        )

    def services(self, said):
        return {"names": [name for name, _ in self.node.get_service_names_and_types()]}

    def action_server(self, said):
        """Orders: 0 to 99 are done with feedback, from 100 on it waits for its cancelling, -1 aborts, -2 is refused."""
        kind = load("test_msgs/action/Fibonacci")

        def execute(handle):
            order = handle.request.order
            result = kind.Result()
            if order < 0:
                handle.abort()
                return result
            numbers = [0, 1]
            feedback = kind.Feedback()
            for _ in range(min(order, 5)):
                numbers.append(numbers[-1] + numbers[-2])
                feedback.sequence = numbers
                handle.publish_feedback(feedback)
            while order >= 100 and not handle.is_cancel_requested:
                time.sleep(0.005)
            result.sequence = numbers
            if handle.is_cancel_requested:
                handle.canceled()
                say(event="cancelled")
            else:
                handle.succeed()
            return result

        self.kept.append(
            ActionServer(
                self.node,
                kind,
                said["action"],
                execute,
                callback_group=self.group,
                goal_callback=lambda goal: GoalResponse.REJECT if goal.order == -2 else GoalResponse.ACCEPT,
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            )
        )

    def send_goal(self, said):
        kind = load("test_msgs/action/Fibonacci")
        goal = kind.Goal()
        goal.order = said["order"]
        self.give(
            said, kind, goal,
            feedback=lambda feedback: {"sequence": list(feedback.sequence)},
            result=lambda result: {"sequence": list(result.sequence)},
        )  # fmt: skip

    def navigator(self, said):
        """To x below 100 it goes in steps, from 100 on it waits to be cancelled, and to what is behind it does not."""
        kind = load("nav2_msgs/action/NavigateToPose")

        def execute(handle):
            x = handle.request.pose.pose.position.x
            say(event="goal", x=x, frame=handle.request.pose.header.frame_id)
            if x < 0:
                handle.abort()
                return kind.Result()
            for left in range(3, -1, -1):
                feedback = kind.Feedback()
                feedback.distance_remaining = float(left)
                feedback.current_pose = handle.request.pose
                handle.publish_feedback(feedback)
            while x >= 100 and not handle.is_cancel_requested:
                time.sleep(0.005)
            if handle.is_cancel_requested:
                handle.canceled()
                say(event="cancelled", x=x)
            else:
                handle.succeed()
            return kind.Result()

        self.kept.append(
            ActionServer(
                self.node, kind, said["action"], execute, callback_group=self.group,
                cancel_callback=lambda _: CancelResponse.ACCEPT,
            )
        )  # fmt: skip

    def navigate(self, said):
        kind = load("nav2_msgs/action/NavigateToPose")
        goal = kind.Goal()
        goal.pose.header.frame_id = "map"
        goal.pose.pose.position.x = float(said["x"])
        self.give(
            said, kind, goal,
            feedback=lambda feedback: {"left": feedback.distance_remaining},
            result=lambda result: {},
        )  # fmt: skip

    def give(self, said, kind, goal, feedback, result):
        """Give a goal; what is heard of it is told as `feedback` and `result` make it of their messages."""
        name, key = said["action"], said["key"]
        client = self.actions.get(name)
        if client is None:
            client = self.actions[name] = ActionClient(self.node, kind, name, callback_group=self.group)
        assert client.wait_for_server(60), "no such action"

        def ended(future):
            answer = future.result()
            say(event="result", key=key, status=answer.status, **result(answer.result))

        def accepted(future):
            handle = future.result()
            say(event="accepted", key=key, accepted=handle.accepted)
            if handle.accepted:
                self.goals[key] = handle
                handle.get_result_async().add_done_callback(ended)

        def heard(message):
            say(event="feedback", key=key, **feedback(message.feedback))

        client.send_goal_async(goal, feedback_callback=heard).add_done_callback(accepted)

    def cancel(self, said):
        future = self.goals[said["key"]].cancel_goal_async()
        future.add_done_callback(
            lambda done: say(event="cancelling", key=said["key"], goals=len(done.result().goals_canceling))
        )


def spin(executor):
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


def main():
    domain, name, *arguments = int(sys.argv[1]), *sys.argv[2:]
    context = Context()
    rclpy.init(args=arguments, context=context, domain_id=domain)
    node = Node(name, context=context)
    executor = MultiThreadedExecutor(4, context=context)
    executor.add_node(node)
    thread = threading.Thread(target=spin, args=(executor,), daemon=True)
    thread.start()
    peer = Peer(node)
    say(event="ready", succeeded=GoalStatus.STATUS_SUCCEEDED)
    for line in sys.stdin:
        said = json.loads(line)
        try:
            answer = getattr(peer, said["do"])(said) or {}
        except Exception as error:  # noqa: BLE001  told to the test, which fails with it
            answer = {"error": f"{type(error).__name__}: {error}"}
        say(id=said["id"], **answer)
    rclpy.shutdown(context=context)


if __name__ == "__main__":
    main()
