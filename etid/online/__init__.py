"""The tracker: a fit after every pulse, for each electrode of a display."""
