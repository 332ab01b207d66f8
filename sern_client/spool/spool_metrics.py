"""The metrics of store and forward at a client."""

from sern_client.spool.spool import Spool
from sern_core.vocabulary.types import DropReason
from sern_runtime.metrics import Metrics


def register_spool(metrics: Metrics, spool: Spool | None) -> None:
    """Have `metrics` read it; None: there is nothing, and all of them are 0."""
    keeper, filler = (None, None) if spool is None else (spool.keeper, spool.filler)
    serving, fetching = (None, None) if spool is None else (spool.serving, spool.fetching)
    both = (("kept", keeper), ("fetched", filler))
    metrics.counter(
        "sern_spool_stored_total",
        "Messages that were written to the spool: kept here, and fetched from others.",
        ("what",),
        lambda: [((what,), float(0 if each is None else each.written)) for what, each in both],
    )
    metrics.counter(
        "sern_spool_dropped_total",
        "Messages that were not written to the spool: the disk was too slow (queue_full), or refused them (storage).",
        ("what", "reason"),
        lambda: [
            ((what, str(reason)), float(count))
            for what, each in both
            for reason, count in (
                (DropReason.QUEUE_FULL, 0 if each is None else each.overflowed),
                (DropReason.STORAGE, 0 if each is None else each.failed),
            )
        ],
    )
    metrics.gauge(
        "sern_spool_bytes",
        "Bytes of the files of the spool.",
        ("what",),
        lambda: [((what,), float(0 if each is None else each.store.kept_bytes)) for what, each in both],
    )
    metrics.gauge(
        "sern_spool_problem",
        "1 while nothing is written to the spool, for the reason that is in the log.",
        read=lambda: [((), float(spool is not None and spool.problem is not None))],
    )
    metrics.counter(
        "sern_spool_deleted_messages_total",
        "Kept messages that were deleted, the oldest file first, to make room for new ones.",
        read=lambda: [((), float(0 if keeper is None else keeper.store.deleted_messages))],
    )
    metrics.counter(
        "sern_spool_deleted_files_total",
        "Files of kept messages that were deleted to make room for new ones.",
        read=lambda: [((), float(0 if keeper is None else keeper.store.deleted_files))],
    )
    metrics.counter(
        "sern_spool_damaged_total",
        "Files of the spool that could not be read, or not to their end, and messages that were not as written.",
        read=lambda: [((), float(sum(0 if each is None else each.store.damaged for _what, each in both)))],
    )
    metrics.counter(
        "sern_spool_sent_total",
        "Kept messages that were sent to sites that fetched them.",
        read=lambda: [((), float(0 if serving is None else serving.sent))],
    )
    metrics.counter(
        "sern_spool_sent_bytes_total",
        "Bytes of those messages.",
        read=lambda: [((), float(0 if serving is None else serving.sent_bytes))],
    )
    metrics.counter(
        "sern_spool_refused_total",
        "Requests, reports and answers of others that are none, or too many.",
        read=lambda: [
            ((), float((0 if serving is None else serving.refused) + (0 if fetching is None else fetching.refused)))
        ],
    )
    metrics.gauge(
        "sern_spool_missing_messages",
        "Messages that others have kept and that are not here, at most.",
        read=lambda: [((), float(0 if fetching is None else sum(m.messages for m in fetching.missing().values())))],
    )
    metrics.gauge(
        "sern_spool_missing_bytes",
        "Bytes of those messages, about.",
        read=lambda: [((), float(0 if fetching is None else sum(m.nbytes for m in fetching.missing().values())))],
    )
    metrics.counter(
        "sern_spool_not_fetched_total",
        "Messages that are not asked for any more: the robot had them no more (gone), or there were too many gaps to "
        "remember (given_up).",
        ("why",),
        lambda: [((why,), float(0 if fetching is None else fetching.counts()[why])) for why in ("gone", "given_up")],
    )
    metrics.counter(
        "sern_spool_unasked_total",
        "Messages that came as fetched and were not asked for, or were here already.",
        read=lambda: [((), float(0 if fetching is None else fetching.unasked))],
    )
