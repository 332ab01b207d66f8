"""What a call costs in steps of Python's own interpreter, which are the same in every run."""

import gc
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any


def steps(call: Callable[[], object], *, within: str | None = None) -> int:
    """How many instructions of the interpreter a call takes; `within`: of the code of one file only."""
    count = 0

    def trace(frame: FrameType, event: str, _argument: Any) -> Any:
        nonlocal count
        if within is not None and frame.f_code.co_filename != within:
            return None
        frame.f_trace_opcodes = True
        count += event == "opcode"
        return trace

    before, collects = sys.gettrace(), gc.isenabled()
    gc.disable()  # what is collected meanwhile may have finalizers of its own
    sys._getframe().f_trace_opcodes = (
        True  # else Python 3.12 tells of none while a process does this for the first time
    )
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
        if collects:
            gc.enable()
    assert count > 0
    return count
