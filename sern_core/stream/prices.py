"""What messages that wait count for beside their bodies, and what giving them up costs."""

from typing import Final

MESSAGE_OVERHEAD_BYTES: Final = 768
"""What a retained message counts for beside its body: what its objects take, up to the next multiple of 256. Else the
bound of a stream of many small ones would bound neither memory nor what their end costs. CPython 3.11 takes 420 bytes
for one of two bytes that waits, and 600 while it is in flight, of which 170 and 350 are for each receiver."""

CLIENT_OVERHEAD_BYTES: Final = 2048
"""What it counts for, beside its body, in the bound of all that waits for one client. That is more than it takes: a
client ends all that waits for it at a word, in one turn of the loop, and 64,000 messages are what ends in 20 ms."""

GIVEN_UP_US: Final = 3
"""What giving up one message, and telling its origin, is charged with to whoever sets it off
(`Reassembly.work_us`)."""

CLEARED_PER_US: Final = 2
"""Messages of a run that are given up at once and told of together: what they are charged with beside `GIVEN_UP_US` for
the run."""
