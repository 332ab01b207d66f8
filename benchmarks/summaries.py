"""What each kind of summary makes of LiDAR scans, what it costs, and what the event loop feels of it.

    python -m benchmarks.summaries [--scans A.ply B.ply] [--plots DIRECTORY]

Without --scans the two that are beside the checkout (`benchmarks.recordings`), or made-up ones, which a note says.
Clouds are the scans as sensor_msgs/PointCloud2 with x, y, z and intensity. The map is made of their obstacle masks: a
robot drives 30 m across a map of 100 x 100 m in cells of 0.1 m and adds what it sees every 0.5 m. Transforms are those
of a robot with 12 joints and 4 nodes at 50 Hz, merged at 20 Hz. `packed` is a body after Zstandard level 3, as the link
would send it. `loop` is the longest that a callback of the event loop waited for its turn while a cloud was made into a
summary in a thread, `inline` the same on the loop itself.
"""

import argparse
import asyncio
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
from numpy.typing import NDArray

from benchmarks import recordings
from benchmarks.common import Report, interleaved, main, pyplot, save
from sern_client.endpoints.clouds import cloud_body, read_ply
from sern_core.bodies.codecs import encode
from sern_core.summaries.bodies import Header
from sern_core.summaries.clouds import read_cloud
from sern_core.summaries.grids import Grid, GridFrame, read_grid, write_grid
from sern_core.summaries.mask import MaskMaker, MaskParams
from sern_core.summaries.patches import GridRebuilder, PatchMaker, PatchParams
from sern_core.summaries.scan import ScanMaker, ScanParams
from sern_core.summaries.transforms import Transform, TransformMerger, write_transforms
from sern_core.summaries.voxel import VoxelPoint, thin_cloud
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import UsageError
from sern_core.vocabulary.types import Encoding

CDR = Encoding.CDR
MAP_CELLS = 1000
STEP_CELLS = 5
STEPS = 60
JOINTS, NODES, TF_HZ, MERGED_HZ = 12, 4, 50, 20
LOOP_LIMIT_MS = 5.0


def packed(body: bytes) -> int:
    return len(encode(Compression.ZSTD, body)[1])


def cpu_ms(work: Callable[[], object], rounds: int) -> float:
    times = []
    for _ in range(rounds):
        begun_s = time.thread_time()
        work()
        times.append(time.thread_time() - begun_s)
    return median(times) * 1e3


def cloud_makers() -> dict[str, Callable[[bytes], bytes]]:
    scan, mask = ScanMaker(ScanParams()), MaskMaker(MaskParams())
    makers: dict[str, Callable[[bytes], bytes]] = {
        f"voxel {voxel_m:g} m": partial(thin_cloud, encoding=CDR, voxel_m=voxel_m) for voxel_m in (0.05, 0.1, 0.2, 0.5)
    }
    makers["voxel 0.1 m, first"] = lambda body: thin_cloud(body, CDR, 0.1, point=VoxelPoint.FIRST)
    makers["voxel 0.1 m, x y z"] = lambda body: thin_cloud(body, CDR, 0.1, fields=())
    makers["scan"] = lambda body: scan.scan(body, CDR)
    makers["occupancy_mask"] = lambda body: mask.mask(body, CDR)
    return makers


async def loop_wait_ms(work: Callable[[], object], *, thread: bool) -> float:
    """The longest gap between two turns of a busy loop while `work` is done."""
    loop = asyncio.get_running_loop()
    longest_s, last_s, done = 0.0, time.perf_counter(), False

    def beat() -> None:
        nonlocal longest_s, last_s
        now_s = time.perf_counter()
        longest_s, last_s = max(longest_s, now_s - last_s), now_s
        if not done:
            loop.call_soon(beat)

    beat()
    with ThreadPoolExecutor(1) as executor:
        await loop.run_in_executor(executor, int)  # the thread exists
        last_s, longest_s = time.perf_counter(), 0.0
        if thread:
            await loop.run_in_executor(executor, work)
        else:
            work()
            await asyncio.sleep(0)
    done = True
    return longest_s * 1e3


def wait_ms(work: Callable[[], object], *, thread: bool) -> float:
    return asyncio.run(loop_wait_ms(work, thread=thread))


def mapping(clouds: list[bytes]) -> list[bytes]:
    """The grids of a robot that drives along and maps, seeing the scans in turn."""
    masks = [read_grid(MaskMaker(MaskParams()).mask(cloud, CDR), CDR).cells for cloud in clouds]
    side = masks[0].shape[0]
    cells: NDArray[np.int8] = np.full((MAP_CELLS, MAP_CELLS), -1, np.int8)
    frame = GridFrame(0.1, MAP_CELLS, MAP_CELLS, (-50.0, -50.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    grids = []
    for step in range(STEPS):
        x = 200 + step * STEP_CELLS
        part = cells[400 : 400 + side, x : x + side]
        seen = masks[step % len(masks)]
        np.copyto(part, seen, where=(seen >= 0) & (part != seen) & ((part < 0) | (seen == 100)))
        grids.append(write_grid(Grid(Header(step, 0, "map"), (0, 0), frame, cells), CDR))
    return grids


def measure_map(report: Report, clouds: list[bytes]) -> None:
    grids = mapping(clouds)
    maker, rebuilder = PatchMaker(PatchParams(), CDR), GridRebuilder(CDR)
    sent = packed_bytes = seq = 0
    make_s: list[float] = []
    rebuild_s: list[float] = []
    for stamp_ns, grid in enumerate(grids, 1):
        begun_s = time.thread_time()
        change = maker.change(grid, now=float(stamp_ns))
        make_s.append(time.thread_time() - begun_s)
        begun_s = time.thread_time()
        shown = None if change.whole is None else rebuilder.keyframe(change.whole, stamp_ns=stamp_ns)
        for update in change.updates:
            seq += 1
            shown = rebuilder.update(update, seq=seq, stamp_ns=stamp_ns) or shown
        rebuild_s.append(time.thread_time() - begun_s)
        if shown != grid:
            raise UsageError("the receiver shows another grid than was sent")
        bodies = [*change.updates, *([change.whole] if change.whole is not None else [])]
        sent += sum(map(len, bodies))
        packed_bytes += sum(map(packed, bodies))
    raw, count = sum(map(len, grids)), len(grids)
    raw_packed = sum(map(packed, grids))
    report.row("map", "raw", body_bytes=raw / count, part_percent=100.0, packed_bytes=raw_packed / count)
    report.row(
        "map",
        "patches",
        body_bytes=sent / count,
        part_percent=100.0 * sent / raw,
        packed_bytes=packed_bytes / count,
        cpu_ms=median(make_s) * 1e3,
        receiver_cpu_ms=median(rebuild_s) * 1e3,
    )
    report.note(f"map: {count} grids, {maker.keyframes} of them sent whole; every one was rebuilt exactly")


def measure_transforms(report: Report, rounds: int) -> None:
    """One second of transforms."""
    turn = (0.0, 0.0, 0.0, 1.0)
    bodies = []
    for step in range(TF_HZ):
        for node in range(NODES):
            joints = range(node, JOINTS, NODES)
            header = Header(step, 0, "base_link")
            bodies.append(write_transforms([Transform(header, f"joint_{j}", (0.0, 0.0, j), turn) for j in joints], CDR))
    flush_every = len(bodies) // MERGED_HZ
    merged: list[bytes] = []

    def merge() -> None:
        merged.clear()
        merger = TransformMerger(CDR)
        for number, body in enumerate(bodies, 1):
            merger.add(body, now=0.0)
            if number % flush_every == 0:
                merged.append(merger.take(now=0.0) or b"")

    spent_ms = cpu_ms(merge, rounds)
    raw, out = sum(map(len, bodies)), sum(map(len, merged))
    report.row("/tf, 1 s", f"raw, {len(bodies)} messages", body_bytes=float(raw), part_percent=100.0)
    report.row(
        "/tf, 1 s",
        f"merged, {len(merged)} messages",
        body_bytes=float(out),
        part_percent=100.0 * out / raw,
        cpu_ms=spent_ms,
    )


def plot(directory: Path, scan_name: str, cloud: bytes) -> None:
    """The cloud, a thinned one, its scan and its mask, to look at."""
    xyz = read_cloud(cloud, CDR).xyz()
    thin = read_cloud(thin_cloud(cloud, CDR, 0.2), CDR).xyz()
    maker = ScanMaker(ScanParams())
    ranges = np.frombuffer(maker.scan(cloud, CDR)[-4 - 4 * maker.params.beams : -4], "<f4")
    bearings = -np.pi + np.arange(len(ranges)) * (2 * np.pi / len(ranges))
    mask = read_grid(MaskMaker(MaskParams()).mask(cloud, CDR), CDR)
    figure, axes = pyplot("--plots").subplots(1, 4, figsize=(20, 5.4))
    for axis, points, title in (
        (axes[0], xyz, f"{scan_name}: {len(xyz):,} points"),
        (axes[1], thin, f"voxel 0.2 m: {len(thin):,} points"),
        (axes[2], xyz, "scan (black) on the cloud"),
    ):
        axis.scatter(points[:, 0], points[:, 1], c=points[:, 2], s=0.4, vmin=-2.5, vmax=2.5, cmap="viridis")
        axis.set_title(title)
    seen = np.isfinite(ranges)
    axes[2].plot(ranges[seen] * np.cos(bearings[seen]), ranges[seen] * np.sin(bearings[seen]), "k.", markersize=3)
    shown = np.where(mask.cells == 100, 0.0, np.where(mask.cells == 0, 0.85, 1.0))
    axes[3].imshow(shown, origin="lower", extent=(-10, 10, -10, 10), cmap="gray", vmin=0, vmax=1)
    axes[3].set_title("occupancy mask (black: occupied, grey: free)")
    for axis in axes:
        axis.set_xlim(-10, 10)
        axis.set_ylim(-10, 10)
        axis.set_aspect("equal")
        axis.set_xlabel("x [m]")
    figure.tight_layout()
    save(figure, directory / "summaries.png", dpi=70)


def arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scans",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="LiDAR scans, .ply (default: those beside the checkout, else made-up ones)",
    )
    parser.add_argument("--plots", type=Path, metavar="DIRECTORY", help="also draw summaries.png there")


def run(options: argparse.Namespace, report: Report) -> None:
    rounds = 3 if options.quick else 25
    if options.scans:
        names, scans = [path.name for path in options.scans], [read_ply(path) for path in options.scans]
    else:
        made = set(recordings.absent()) & set(recordings.SCANS)
        names, scans = ["made-up scan" if made else name for name in recordings.SCANS], recordings.scans()
    report.note(f"scans: {', '.join(names)}")
    clouds = [cloud_body(scan, 10**18, "velodyne", CDR) for scan in scans]
    raw = sum(map(len, clouds)) / len(clouds)
    report.row("cloud", "raw", body_bytes=raw, part_percent=100.0, packed_bytes=sum(map(packed, clouds)) / len(clouds))
    for name, make in cloud_makers().items():
        bodies = [make(cloud) for cloud in clouds]
        size = sum(map(len, bodies)) / len(bodies)
        waits = interleaved(
            {
                "thread": partial(wait_ms, partial(make, clouds[0]), thread=True),
                "inline": partial(wait_ms, partial(make, clouds[0]), thread=False),
            },
            rounds,
        )
        report.row(
            "cloud",
            name,
            body_bytes=size,
            part_percent=100.0 * size / raw,
            packed_bytes=sum(map(packed, bodies)) / len(bodies),
            cpu_ms=median(cpu_ms(partial(make, cloud), rounds) for cloud in clouds),
            loop_ms=median(waits["thread"]),
            inline_ms=median(waits["inline"]),
        )
    measure_map(report, clouds)
    measure_transforms(report, rounds)
    worst_ms = max(row.metrics["loop_ms"] for row in report.rows if "loop_ms" in row.metrics)
    report.reach("longest wait of the event loop for a cloud in the thread [ms]", worst_ms, LOOP_LIMIT_MS)
    if options.plots is not None:
        plot(options.plots, names[0], clouds[0])


if __name__ == "__main__":
    sys.exit(main("summaries", run, description=__doc__, arguments=arguments))
