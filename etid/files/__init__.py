"""Files of other programs: import by a mapping, export, and one reader for each format.

etid's own files belong to `etid.recordings` and `etid.results`.
"""
