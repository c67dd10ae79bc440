"""What a stimulator gives, as the page is told by `etid.live.stimulator`."""

import enum


class Output(enum.IntEnum):
    """States of the output; the page has the same numbers."""

    UNKNOWN = 0  # no stimulator is controlled
    REST = 1  # 0, until pulses come
    RUNNING = 2
    ZERO = 3  # 0 for good
    LOST = 4  # 0 could not be sent
