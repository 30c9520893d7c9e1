"""The executor of the nodes, with few and cheap wake-ups; where it fails, rclpy has its own.

For each message rclpy builds two wait sets of all entities of the node, in Python, which costs
more than the message. `KeptWaitSet` lists the entities once. An IMU would still wake it hundreds
of times a second, while its samples are needed only when a frame waits for them, some thirty
times. Until then they stay in the queue of the middleware (`PolledSubscription`).

`KeptWaitSet` uses private parts of rclpy. `make_executor` tries it on the node at the start. Where
that fails, rclpy's `SingleThreadedExecutor` runs the node, and each message is an ordinary
callback: the same results with more load.
"""

from collections.abc import Callable
from contextlib import ExitStack
import os
import threading
import time
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile

# Period [s] at which events, such as a publisher whose QoS does not match, are looked for; rclpy
# logs them. Each look costs a wait set of all events. [chosen: a person reads the log, so that any
# value from 0.2 to 5 would do]
_EVENTS_PERIOD = 1.0
# Time [s] that the self-test waits for a task and for a timer. A start on a busy machine that
# takes longer falls back without need; a broken executor delays the start by this time. [chosen:
# both are due at once, so that any value from 0.2 to 3 would do]
_TEST_TIME = 1.0


class KeptWaitSet(SingleThreadedExecutor):
    """Executor of one node that calls subscriptions and timers itself, and rclpy for the rest.

    The entities of the node are listed again when one is made or destroyed: that triggers the
    guard of rclpy's executor.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._in_use = ExitStack()  # handles that must not be destroyed
        self._wait_set: Any = None
        self._events_at = 0.0

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for something to do, without a limit for None, and do it."""
        if self._wait_set is None:
            self._list_entities()
        events = self._fill_wait_set()
        # Tasks whose guard rclpy has read while it looked for other work: nothing else wakes it.
        has_tasks = any(not task.done() for task, _, _ in self._tasks)
        nanoseconds = -1 if timeout_sec is None else int(timeout_sec * 1e9)
        wait_set = self._wait_set
        wait_set.wait(0 if has_tasks else nanoseconds)
        if not self.context.ok():
            raise ExternalShutdownException
        if (
            has_tasks
            or wait_set.get_ready_entities('guard_condition')
            or wait_set.get_ready_entities('service')
            or any(event.is_ready(wait_set) for event in events)
        ):
            self.release()
            super().spin_once(0.0)
            self._cb_iter = None  # forget what else was ready
            return
        self._call_ready()

    def release(self) -> None:
        """Let entities be destroyed; the next `spin_once` lists them again."""
        self._in_use.close()
        self._wait_set = None

    def _fill_wait_set(self) -> list[Any]:
        """Add all that may be ready. Returns the events among it, mostly none."""
        self._wait_set.clear_entities()
        self._wait_set.add_guard_condition(self._guard.handle)
        for timer in self._timers:
            self._wait_set.add_timer(timer.handle)
        for service in self._services:
            self._wait_set.add_service(service.handle)
        for subscription in self._subscriptions:
            group = subscription.callback_group
            if not isinstance(group, _WhileUrgent) or group.is_urgent():
                self._wait_set.add_subscription(subscription.handle)
        now = time.monotonic()
        if now <= self._events_at + _EVENTS_PERIOD:
            return []
        self._events_at = now
        for event in self._events:
            event.add_to_wait_set(self._wait_set)
        return self._events

    def _call_ready(self) -> None:
        """Call the timers and subscriptions that are ready."""
        ready = self._wait_set.get_ready_entities('timer')
        for timer in self._timers if ready else ():
            if timer.handle.pointer in ready and timer.handle.is_timer_ready():
                timer.handle.call_timer()
                timer.callback()
        ready = self._wait_set.get_ready_entities('subscription')
        for subscription in self._subscriptions if ready else ():
            if subscription.handle.pointer in ready:
                for message in _take(subscription, 1):
                    subscription.callback(message)

    def _list_entities(self) -> None:
        (node,) = self.get_nodes()
        self._timers = [*node.timers]
        self._services = [*node.services]
        self._subscriptions = [*node.subscriptions]
        self._events = [*node.waitables]
        with_handles: list[Any] = [*self._timers, *self._services, *self._subscriptions]
        with_handles += [self._guard, self.context]
        for used in (*(entity.handle for entity in with_handles), *self._events):
            self._in_use.enter_context(used)
        self._wait_set = rclpy_implementation.WaitSet(
            len(self._subscriptions),
            1,
            len(self._timers),
            0,
            len(self._services),
            sum(event.get_num_entities().num_events for event in self._events),
            self.context.handle,
        )


def _take(subscription: Any, most: int) -> list[Any]:
    """Take at most so many messages from the queue of the middleware."""
    messages: list[Any] = []
    with subscription.handle:
        while len(messages) < most:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            messages.append(taken[0])
    return messages


def make_executor(node: Node) -> tuple[SingleThreadedExecutor, str]:
    """Executor with the node; and why it is not `KeptWaitSet`, empty if it is.

    RS_RELPOSE_PUBLIC_RCLPY in the environment chooses the executor of rclpy.
    """
    if os.environ.get('RS_RELPOSE_PUBLIC_RCLPY'):
        problem = 'RS_RELPOSE_PUBLIC_RCLPY is set'
    else:
        kept = KeptWaitSet(context=node.context)
        kept.add_node(node)
        problem = _self_test(kept, node)
        if not problem:
            return kept, ''
        kept.release()
        kept.remove_node(node)
    public = SingleThreadedExecutor(context=node.context)
    public.add_node(node)
    return public, problem


def _self_test(executor: SingleThreadedExecutor, node: Node) -> str:
    """Whether an executor runs a task and a timer of its node; why not, empty if it does."""
    if not hasattr(rclpy_implementation.Subscription, 'take_message'):
        return 'subscriptions of this rclpy have no take_message'
    task_ran = threading.Event()
    timer_ran = threading.Event()
    executor.create_task(task_ran.set)
    steady = Clock(clock_type=ClockType.STEADY_TIME)  # the clock of the node may be /clock
    timer = node.create_timer(0.0, timer_ran.set, clock=steady)
    end = time.monotonic() + _TEST_TIME
    try:
        while not (task_ran.is_set() and timer_ran.is_set()):
            if time.monotonic() > end:
                return f'it calls no {"timer" if task_ran.is_set() else "task"}'
            executor.spin_once(_TEST_TIME)
    except (AttributeError, TypeError, RuntimeError) as error:  # of other private parts
        return f'{type(error).__name__}: {error}'
    finally:
        node.destroy_timer(timer)
    return ''


# Most messages that are taken at once, so that other callbacks get their turn. [chosen: the depth
# of the IMU's queue, of which no more can wait]
_MOST_AT_ONCE = 2000


class PolledSubscription:
    """A subscription that is read by `drain`, and wakes the executor only while it is urgent.

    `receive` gets the messages; `urgent` is called before the executor waits. The depth of `qos`
    must hold the messages between two calls of `drain`. With another executor than `KeptWaitSet`
    each message is received when it comes, and `drain` has nothing to do.
    """

    def __init__(
        self,
        node: Node,
        msgtype: type,
        topic: str,
        qos: QoSProfile,
        receive: Callable[[list[Any]], None],
        urgent: Callable[[], bool],
        **options: Any,
    ) -> None:
        self._node = node
        self._receive = receive
        self._subscription = node.create_subscription(
            msgtype, topic, self.drain, qos, callback_group=_WhileUrgent(urgent), **options
        )

    def drain(self, *received: Any) -> None:
        """Receive all messages of the queue, after those that the executor has taken from it."""
        messages = [*received]
        if isinstance(self._node.executor, KeptWaitSet):
            messages += _take(self._subscription, _MOST_AT_ONCE)
        if messages:
            self._receive(messages)


class _WhileUrgent(CallbackGroup):
    """Tells `KeptWaitSet` whether to wait for the subscription; rclpy's executor always does."""

    def __init__(self, is_urgent: Callable[[], bool]) -> None:
        super().__init__()
        self.is_urgent = is_urgent

    def can_execute(self, entity: Any) -> bool:
        return True

    def beginning_execution(self, entity: Any) -> bool:
        return True

    def ending_execution(self, entity: Any) -> None:
        pass
