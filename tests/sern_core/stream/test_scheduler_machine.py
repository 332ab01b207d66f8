"""The choice is the one that rescoring everything would make, in every state that random operations reach."""

from hypothesis import assume, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, precondition, rule

from sern_core.stream.pending import FEW
from sern_core.stream.scheduler import CREDIT_QUANTA, DEFAULT_QUANTUM_BYTES, Scheduler
from sern_core.vocabulary.params import SchedulerParams
from sern_core.vocabulary.types import CLASSES, PriorityClass
from tests.exploring import cases

CONTROL, STATE, BULK = CLASSES
SLOTS = 3 * FEW
Message = tuple[PriorityClass, float, float, float]  # class, κ, s, since

channel_ids = st.integers(0, SLOTS - 1)
priorities = st.sampled_from([CONTROL, STATE, BULK, BULK, BULK])
weights = st.sampled_from([0.5, 1.0, 3.0, 10.0])
sizes = st.integers(0, 100_000).map(float)
steps_s = st.sampled_from([0.0, 1e-4, 0.003, 0.05, 0.7, 5.0])


class SchedulerMachine(RuleBasedStateMachine):
    """The model keeps plain dictionaries and plain counters, and scores everything at each choice."""

    touched = Bundle("touched")

    @initialize(
        start=st.sampled_from([0.0, 12.5, 3e6]),
        eta=st.sampled_from([0.0, 0.1, 1.0, 20.0]),
        a_max_s=st.sampled_from([0.0, 0.5, 10.0]),
        floor=st.sampled_from([0.0, 0.1, 0.3]),
    )
    def start(self, start: float, eta: float, a_max_s: float, floor: float) -> None:
        self.params = SchedulerParams(eta=eta, a_max_s=a_max_s, floor=floor)
        self.now = start
        self.scheduler = Scheduler(self.params, now=start)
        self.pending: dict[int, Message] = {}
        self.encoding: dict[int, Message] = {}
        self.credit = {STATE: 0.0, BULK: 0.0}
        self.tokens: tuple[float, float, float] | None = None  # bytes, rate in bytes/s, burst

    # The model

    def backlogged(self, priority: PriorityClass) -> bool:
        return any(m[0] is priority for m in (*self.pending.values(), *self.encoding.values()))

    def waiting(self, priority: PriorityClass) -> bool:
        return any(m[0] is priority for m in self.pending.values())

    def forget_credit(self) -> None:
        for priority in (STATE, BULK):
            if not self.backlogged(priority):
                self.credit[priority] = min(self.credit[priority], 0.0)

    def class0_may_pass(self) -> bool:
        return self.tokens is None or self.tokens[0] >= 0.0

    def served_class(self, *, window_open: bool) -> PriorityClass | None:
        urgent = self.waiting(CONTROL) and self.class0_may_pass()
        if not window_open:
            return CONTROL if urgent else None
        order = [CONTROL] * urgent + [STATE] * self.waiting(STATE) + [BULK] * self.waiting(BULK)
        for priority in order[1:]:
            if self.credit[priority] >= DEFAULT_QUANTUM_BYTES:
                return priority
        if order:
            return order[0]
        return CONTROL if self.waiting(CONTROL) else None

    def score(self, channel_id: int) -> float:
        _, weight, size_bytes, since_s = self.pending[channel_id]
        age_s = min(self.now - since_s, self.params.a_max_s)
        return weight * (1.0 + self.params.eta * age_s) / (size_bytes + self.params.epsilon_bytes)

    # The operations

    @rule(
        target=touched,
        channel_id=channel_ids,
        priority=priorities,
        weight=weights,
        size_bytes=sizes,
        waited_s=st.sampled_from([0.0, 0.0, 0.01, 0.49, 3.0, 30.0]),
    )
    def offer(self, channel_id: int, priority: PriorityClass, weight: float, size_bytes: float, waited_s: float) -> int:
        self.put(channel_id, (priority, weight, size_bytes, self.now - waited_s))
        return channel_id

    @rule(
        target=touched, first=channel_ids, count=st.integers(FEW // 2, 2 * FEW), priority=priorities, size_bytes=sizes
    )
    def offer_many(self, first: int, count: int, priority: PriorityClass, size_bytes: float) -> int:
        for step in range(count):
            channel_id = (first + step) % SLOTS
            self.put(channel_id, (priority, 1.0 + step % 3, size_bytes + 37.0 * (step % 7), self.now - 0.11 * step))
        return first

    def put(self, channel_id: int, message: Message) -> None:
        priority, weight, size_bytes, since_s = message
        self.scheduler.offer(channel_id, priority=priority, weight=weight, size_bytes=size_bytes, since_s=since_s)
        self.encoding.pop(channel_id, None)
        self.pending[channel_id] = message
        self.forget_credit()

    @rule(channel_id=touched, share=st.floats(0.0, 1.0))
    def shrink(self, channel_id: int, share: float) -> None:
        assume(channel_id in self.pending)
        priority, weight, size_bytes, since_s = self.pending[channel_id]
        self.put(channel_id, (priority, weight, size_bytes * share, since_s))

    @rule(channel_id=touched, encoding=st.booleans())
    def withdraw(self, channel_id: int, encoding: bool) -> None:
        self.scheduler.withdraw(channel_id, encoding=encoding)
        message = self.pending.pop(channel_id, None)
        if message is not None and encoding:
            self.encoding[channel_id] = message
        elif not encoding:
            self.encoding.pop(channel_id, None)
        self.forget_credit()

    @rule(first=channel_ids, count=st.integers(1, SLOTS))
    def withdraw_many(self, first: int, count: int) -> None:
        for step in range(count):
            self.withdraw((first + step) % SLOTS, encoding=False)

    @rule(priority=st.sampled_from(CLASSES), nbytes=st.integers(0, 9_000))
    def charge(self, priority: PriorityClass, nbytes: int) -> None:
        if priority is CONTROL and self.tokens is not None:
            tokens, rate, burst = self.tokens
            self.tokens = (max(tokens - nbytes, -burst), rate, burst)
        self.scheduler.charge(priority, nbytes, now=self.now)
        urgent = self.waiting(CONTROL) and self.class0_may_pass()
        for lower in (STATE, BULK):
            own_right = priority is lower and not urgent and not (lower is BULK and self.waiting(STATE))
            self.credit[lower] += self.params.floor * nbytes
            if priority is lower and not own_right:
                self.credit[lower] -= nbytes
            most = CREDIT_QUANTA * DEFAULT_QUANTUM_BYTES if self.backlogged(lower) and not own_right else 0.0
            self.credit[lower] = min(self.credit[lower], most)

    @rule(step_s=steps_s)
    def wait(self, step_s: float) -> None:
        self.now += step_s
        if self.tokens is not None:
            tokens, rate, burst = self.tokens
            self.tokens = (min(tokens + rate * step_s, burst), rate, burst)

    @rule(rate_bps=st.none() | st.sampled_from([1e5, 1e6, 2e7]))
    def set_rate(self, rate_bps: float | None) -> None:
        self.scheduler.set_rate(rate_bps, now=self.now)
        if rate_bps is None:
            self.tokens = None
            return
        rate = self.params.class0_share * rate_bps / 8.0
        burst = max(4096.0, 0.05 * rate)
        before = burst if self.tokens is None else self.tokens[0]
        self.tokens = (min(max(before, -burst), burst), rate, burst)

    @precondition(lambda self: self.pending)
    @rule(fragment_bytes=st.sampled_from([300.0, 1200.0, 8192.0]), window_open=st.booleans())
    def serve(self, fragment_bytes: float, window_open: bool) -> None:
        """What the link does: pick, send one fragment, charge, offer the rest."""
        channel_id = self.scheduler.pick(now=self.now, window_open=window_open)
        if channel_id is None:
            return
        priority, weight, size_bytes, since_s = self.pending[channel_id]
        sent_bytes = min(size_bytes, fragment_bytes)
        self.charge(priority, int(sent_bytes))
        if sent_bytes == size_bytes:
            self.withdraw(channel_id, encoding=False)
        else:
            self.put(channel_id, (priority, weight, size_bytes - sent_bytes, since_s))

    # What must hold in every state

    @invariant()
    def choice_is_that_of_brute_force(self) -> None:
        if self.tokens is not None and abs(self.tokens[0]) < 1e-2 + 1e-7 * self.tokens[1]:
            return  # the bucket is within rounding of turning
        if any(abs(credit - DEFAULT_QUANTUM_BYTES) < 1e-6 for credit in self.credit.values()):
            return
        for window_open in (True, False):
            channel_id = self.scheduler.pick(now=self.now, window_open=window_open)
            assert channel_id == self.scheduler.pick(now=self.now, window_open=window_open), "asking changes nothing"
            expected = self.served_class(window_open=window_open)
            if expected is None:
                assert channel_id is None
                continue
            assert channel_id is not None
            assert self.pending[channel_id][0] is expected
            best = max(self.score(other) for other, m in self.pending.items() if m[0] is expected)
            # Rounding of α + β·t, and for η = 0 the slow ageing that separates equals.
            assert self.score(channel_id) >= best * (1.0 - 1e-7)
            standing = self.scheduler.explain(channel_id, self.now, window_open=window_open)
            assert standing is not None and standing.waits_for is None

    @invariant()
    def deadline_is_for_those_who_wait(self) -> None:
        for window_open in (True, False):
            deadline = self.scheduler.next_deadline(now=self.now, window_open=window_open)
            if deadline is not None:
                assert deadline > self.now
                assert self.scheduler.pick(now=self.now, window_open=window_open) is None

    def teardown(self) -> None:
        if hasattr(self, "scheduler"):
            self.scheduler.validate()
            assert [self.scheduler.pending(c) for c in CLASSES] == [
                sum(m[0] is c for m in self.pending.values()) for c in CLASSES
            ]


TestSchedulerMachine = SchedulerMachine.TestCase
TestSchedulerMachine.settings = settings(max_examples=cases(50), stateful_step_count=40)
