"""Patterns of names that contain labels, such as `{subject}_{session}_{trial}.csv`."""

import re

from etid.recordings.errors import RecordingError, located
from etid.recordings.fields import LABELS
from etid.recordings.labels import check_names


def pattern(text: str, more: tuple[str, ...] = ()) -> re.Pattern[str]:
    """Expression of the names that fit a pattern; its groups are the labels.

    A label contains none of the characters that separate the labels.

    Args:
        text: The pattern, with labels in braces.
        more: Further names that may stand in braces. Their texts may contain a point.

    Raises:
        RecordingError: A name is unknown or occurs twice, or no text separates two labels.
    """
    parts = re.split(r"\{(\w*)\}", text)
    texts, names = parts[::2], parts[1::2]
    with located(repr(text)):
        check_names(dict.fromkeys(names), (*LABELS, *more), "label")
    if len(set(names)) < len(names) or not names or "" in texts[1:-1]:
        raise RecordingError(
            f"{text!r} has no label, a label twice, or no text between two labels",
            field="labels",
            remedy="Write labels in braces with a character between them, as in "
            "'{subject}_{trial}.csv'",
        )
    ends = [text[:1] for text in texts[1:]] + [text[-1:] for text in texts[:-1]]
    apart = {end for end in ends if end and not end.isalnum()} | {"/"}
    expression = re.escape(texts[0])
    for name, text_after in zip(names, texts[1:], strict=True):
        without = re.escape("".join(sorted(apart - {"."} if name in more else apart)))
        expression += f"(?P<{name}>[^{without}]+){re.escape(text_after)}"
    return re.compile(expression)
