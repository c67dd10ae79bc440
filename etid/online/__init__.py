"""The tracker: one fit per pulse for each electrode of a display."""
