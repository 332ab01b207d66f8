"""`python -m sern_perception.training`: make the network that comes with SERN, or study what adaptations are worth."""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

from sern_core.vocabulary.errors import ConfigError, SernError
from sern_perception.segmenter import WEIGHTS
from sern_perception.training.table import Study, joined, read, table

TRAINING_SCANS = 1600
TEST_SCANS = 160


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m sern_perception.training", description=__doc__)
    parser.add_argument("what", choices=["train", "study"])
    parser.add_argument("--out", type=Path, help="the model, or the JSON of the study, which goes on where it was")
    parser.add_argument("--table", type=Path, nargs="+", help="of studies: print the table of these, and try nothing")
    parser.add_argument("--commit", default="unknown", help="of the code, for the study's table")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=5, help="of the study")
    parser.add_argument("--steps", type=int, help="of each training")
    parser.add_argument("--scans", type=int, default=TRAINING_SCANS, help="to train with")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    try:
        if options.table is not None:
            print(table(joined([read(path) for path in options.table])))
            return 0
        return study(options) if options.what == "study" else make_model(options)
    except SernError as error:
        sys.exit(f"sern_perception.training: {error}")
    except ImportError as error:
        sys.exit(f"sern_perception.training: {error}: install sern[train,sim]")


def make_model(options: argparse.Namespace) -> int:
    from sern_perception.training.exporting import export
    from sern_perception.training.learning import Budget, class_ious, train
    from sern_perception.training.scans import SOURCE, make

    begin_s = time.monotonic()
    budget = Budget(steps=options.steps or 2000, rare=4, threads=options.threads)
    scans = make(options.seed, options.scans, SOURCE)
    print(f"{options.scans} scans after {time.monotonic() - begin_s:.0f} s", flush=True)
    net = train(scans, options.seed, budget, told=lambda text: print(text, flush=True))
    ious = class_ious(net, make(options.seed + 1_000_000, TEST_SCANS, SOURCE))
    out = options.out or WEIGHTS
    export(net, out)
    print(f"mIoU {sum(ious.values()) / len(ious):.3f}: " + ", ".join(f"{name} {iou:.3f}" for name, iou in ious.items()))
    print(f"wrote {out}, {out.stat().st_size} bytes, after {time.monotonic() - begin_s:.0f} s")
    return 0


def study(options: argparse.Namespace) -> int:
    """Seed by seed. Seeds that are in the file are not done again."""
    from sern_perception.training.study import BUDGET, NAMES, tried

    budget = replace(BUDGET, steps=options.steps or BUDGET.steps, threads=options.threads)
    head = {"steps": budget.steps, "batch": budget.batch, "columns": budget.columns}
    found = Study(options.commit, head, [])
    if options.out is not None and options.out.exists():
        found = read(options.out)
        if (found.commit, found.budget) != (options.commit, head):
            raise ConfigError(f"{options.out} is of commit {found.commit} with {found.budget}: give another --out")
    for seed in range(options.seed, options.seed + options.seeds):
        if {each.name for each in found.tried if each.seed == seed} == set(NAMES):
            continue
        rows = []
        for each in tried(seed, budget, lambda text: print(text, flush=True)):
            rows.append(each)
            print(f"seed {seed}, {each.name}: mIoU {each.miou:.3f}", flush=True)
        found = found._replace(tried=[*found.tried, *rows])
        if options.out is not None:
            options.out.write_text(found.as_json())
    print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
