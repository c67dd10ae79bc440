"""Files of other programs: import by a mapping, export, and one reader for each format.

Code for etid's own files belongs to `etid.recordings` and `etid.results`.
"""
