"""Both ends of the ROS 2 benchmark, real rclpy nodes: `ros2_roles.py ROLE DOMAIN`, in a ROS 2 environment.

It imports nothing of SERN. Each line of input is `{"do": ..., ...}` and is answered with one line of JSON; the first
says that it is ready. `source` publishes and serves, `sink` listens and calls. Times are of the monotonic clock, which
all processes of a host share; a message has the time of its publishing in its stamp.

`ros2_roles.py bridge SOURCE TARGET` is the least that a bridge in rclpy can be: one process in both domains that passes
the source's topics, calls and goals on, without a link, queues or anything that may fail.

Nodes have the executor that `rclpy.spin` takes. A MultiThreadedExecutor of Jazzy at times spins on one core for as long
as it lives: a sink with it lost 193 of 500 odometry messages of a source in its own domain, with nothing in between.
"""

# mypy: ignore-errors
# It runs among the packages of ROS, whose types are not known where it is checked.

import array
import contextlib
import json
import sys
import threading
import time
from collections import Counter

import rclpy
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci

ODOM, CLOUD, TALK = "/bench/odom", "/bench/cloud", "/bench/talk"
LAMP, FIBONACCI = "/bench/lamp", "/bench/fibonacci"
DEPTH = 10
"""What a person writes: nothing but a depth, and so reliable and volatile."""
WAIT_S = 60.0
LATE_S = 2.0
"""Feedback may still come for so long after the result."""
_lock = threading.Lock()


def say(**what):
    with _lock:
        print(json.dumps(what), flush=True)


def paced(rate_hz, count, step):
    begin_s = time.monotonic()
    for number in range(count):
        time.sleep(max(0.0, begin_s + number / rate_hz - time.monotonic()))
        step(number)


class End:
    """What both ends have: a topic that both publish and both hear."""

    def __init__(self, node):
        self.node = node
        self.group = ReentrantCallbackGroup()
        self.talk = node.create_publisher(String, TALK, 1000)
        self.heard = Counter()
        node.create_subscription(String, TALK, lambda message: self.heard.update([message.data]), 1000)

    def talked(self, said):
        """How many different messages were heard, and how many more than once."""
        return {"heard": len(self.heard), "doubled": sum(self.heard.values()) - len(self.heard)}

    def chatter(self, said):
        name = self.node.get_name()
        paced(said["rate_hz"], said["count"], lambda number: self.talk.publish(String(data=f"{name} {number}")))


class Source(End):
    def __init__(self, node):
        super().__init__(node)
        self.publishers = {
            ODOM: node.create_publisher(Odometry, ODOM, DEPTH),
            CLOUD: node.create_publisher(PointCloud2, CLOUD, DEPTH),
        }
        self.odom, self.cloud = Odometry(), PointCloud2()
        self.cloud.data = array.array("B", bytes(1_000_000))
        node.create_service(SetBool, LAMP, self.switch, callback_group=self.group)
        self.server = ActionServer(node, Fibonacci, FIBONACCI, self.execute, callback_group=self.group)

    @staticmethod
    def switch(request, response):
        response.success = request.data
        return response

    @staticmethod
    def execute(handle):
        feedback = Fibonacci.Feedback()
        feedback.sequence = [0, 1]
        handle.publish_feedback(feedback)
        handle.succeed()
        return Fibonacci.Result()

    def matched(self, said):
        return {"count": min(publisher.get_subscription_count() for publisher in self.publishers.values())}

    def send(self, said):
        topic = said["topic"]
        message = self.odom if topic == ODOM else self.cloud

        def step(_number):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.monotonic_ns(), 10**9)
            self.publishers[topic].publish(message)

        paced(said["rate_hz"], said["count"], step)


class Sink(End):
    def __init__(self, node):
        super().__init__(node)
        self.delays_ms = {ODOM: [], CLOUD: []}
        for topic, kind in ((ODOM, Odometry), (CLOUD, PointCloud2)):
            node.create_subscription(kind, topic, lambda message, topic=topic: self.came(topic, message), DEPTH)
        self.client = node.create_client(SetBool, LAMP, callback_group=self.group)
        self.goals = ActionClient(node, Fibonacci, FIBONACCI, callback_group=self.group)

    def came(self, topic, message):
        stamp = message.header.stamp
        self.delays_ms[topic].append((time.monotonic_ns() - stamp.sec * 10**9 - stamp.nanosec) / 1e6)

    def delays(self, said):
        return {"ms": self.delays_ms[said["topic"]]}

    def calls(self, said):
        """How long each of some calls took, one after the other."""
        assert self.client.wait_for_service(WAIT_S), "no such service"
        found = []
        for number in range(said["count"]):
            begin_s = time.monotonic()
            ended = threading.Event()
            future = self.client.call_async(SetBool.Request(data=number % 2 == 0))
            future.add_done_callback(lambda _, ended=ended: ended.set())
            assert ended.wait(WAIT_S), "no answer"
            found.append(1000 * (time.monotonic() - begin_s))
        return {"ms": found}

    def give(self, said):
        """Time goals, one by one: until each is accepted, until its feedback and its result are there.

        Feedback is a topic: before its writer knows the new reader, and through a bridge that is late with it, it is
        lost. It is counted then; a result that does not come is an error."""
        assert self.goals.wait_for_server(WAIT_S), "no such action"
        accepted_ms, feedback_ms, result_ms, lost = [], [], [], 0
        for _ in range(said["count"]):
            begin_s = time.monotonic()
            ended, fed = threading.Event(), threading.Event()

            def since(begin_s=begin_s):
                return 1000 * (time.monotonic() - begin_s)

            def feedback(_message, fed=fed, since=since):
                feedback_ms.append(since())
                fed.set()

            def result(_future, ended=ended, since=since):
                result_ms.append(since())
                ended.set()

            def accepted(future, since=since, result=result):
                accepted_ms.append(since())
                future.result().get_result_async().add_done_callback(result)

            self.goals.send_goal_async(Fibonacci.Goal(order=1), feedback_callback=feedback).add_done_callback(accepted)
            assert ended.wait(WAIT_S), "no result"
            lost += not fed.wait(LATE_S)
        return {"accepted_ms": accepted_ms, "feedback_ms": feedback_ms, "result_ms": result_ms, "feedback_lost": lost}


class Bridge:
    """Each domain has a thread; what one waits for comes in the other's. Goals one by one."""

    def __init__(self, source, target):
        for topic, kind in ((ODOM, Odometry), (CLOUD, PointCloud2)):
            publisher = target.create_publisher(kind, topic, DEPTH)
            source.create_subscription(kind, topic, publisher.publish, DEPTH, raw=True)
        calls = source.create_client(SetBool, LAMP)
        target.create_service(SetBool, LAMP, lambda request, _response: calls.call(request))
        self.goals = ActionClient(source, Fibonacci, FIBONACCI)
        self.server = ActionServer(target, Fibonacci, FIBONACCI, self.execute, goal_callback=self.accept)

    def accept(self, goal):
        accepted = threading.Event()
        with _lock:  # before its feedback can come
            self.handle, self.feedback = None, []
        self.given = self.goals.send_goal_async(goal, feedback_callback=self.fed)
        self.given.add_done_callback(lambda _: accepted.set())
        assert accepted.wait(WAIT_S), "no answer"
        return GoalResponse.ACCEPT if self.given.result().accepted else GoalResponse.REJECT

    def fed(self, message):
        with _lock:
            if self.handle is None:
                self.feedback.append(message.feedback)  # the goal is not accepted here yet
                return
        self.handle.publish_feedback(message.feedback)

    def execute(self, handle):
        ended = threading.Event()
        with _lock:
            self.handle, early = handle, self.feedback
        for feedback in early:
            handle.publish_feedback(feedback)
        result = self.given.result().get_result_async()
        result.add_done_callback(lambda _: ended.set())
        assert ended.wait(WAIT_S), "no result"
        handle.succeed()
        return result.result().result


def spin(executor):
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


def join(role, domain):
    """A node in a domain, and the thread that spins it, to be started when the node has all that it has."""
    context = Context()
    rclpy.init(domain_id=domain, context=context)
    node = Node(role, context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    return node, threading.Thread(target=spin, args=(executor,), daemon=True)


def main():
    role, *domains = sys.argv[1:]
    nodes, threads = zip(*(join(role, int(domain)) for domain in domains), strict=True)
    end = {"source": Source, "sink": Sink, "bridge": Bridge}[role](*nodes)
    for thread in threads:
        thread.start()
    say(ready=True)
    for line in sys.stdin:
        said = json.loads(line)

        def work(said=said):
            try:
                say(answer=said["do"], **(getattr(end, said["do"])(said) or {}))
            except Exception as error:  # noqa: BLE001  told to the benchmark, which ends with it
                say(problem=f"{said['do']}: {type(error).__name__}: {error}")

        threading.Thread(target=work, daemon=True).start()


if __name__ == "__main__":
    main()
