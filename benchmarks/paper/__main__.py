"""The paper's tables, figures and claims from runs of our own: `make paper`, `make paper-quick`.

Runs each step, and writes OUT/report.html and OUT/report.pdf. What is done is kept in OUT/results, and
taken from there while the code that it ran is the same: a run that was interrupted, or that lacked something, goes on
where it was. What is missing here, as root, ROS 1 or an extra, leaves out its part, and says why.
"""

import argparse
import signal
import sys
from pathlib import Path
from typing import Final

from benchmarks.paper.running import run_all
from benchmarks.paper.steps import STEPS
from sern_core.vocabulary.errors import SernError

OUT: Final = Path("paper-out")
NAMES: Final = tuple(step.key for step in STEPS)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paper", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--quick", action="store_true", help="few runs of each, in a quarter of an hour")
    parser.add_argument("--out", type=Path, default=OUT, metavar="DIR", help=f"where the report goes (default {OUT})")
    parser.add_argument(
        "--only", nargs="+", choices=NAMES, metavar="STEP", help=f"of {', '.join(NAMES)}; others are left out"
    )
    return parser.parse_args()


def main() -> int:
    options = arguments()
    steps = [step for step in STEPS if options.only is None or step.key in options.only]
    for number in (signal.SIGINT, signal.SIGTERM):  # a shell's job in the background ignores the first
        signal.signal(number, signal.default_int_handler)
    out = options.out.resolve()
    folder = out / "results"
    try:
        results = run_all(steps, folder, quick=options.quick)
        from benchmarks.paper import report  # after the runs: what it needs is needed for nothing else

        page, pdf = out / "report.html", out / "report.pdf"
        page.write_text(report.html(results, folder, quick=options.quick), encoding="utf-8")
        print(f"{page}")
        report.print_pdf(page, pdf)
        print(f"{pdf}")
    except ImportError as error:
        print(f"benchmarks.paper: the report needs {error.name}: pip install 'sern[report,twin]'", file=sys.stderr)
        return 1
    except (SernError, OSError) as error:
        print(f"benchmarks.paper: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"\nbenchmarks.paper: interrupted; the same command goes on where it was, from {folder}", file=sys.stderr)
        return 130
    return 0 if not any(result.failed for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
