"""Functions that identify one recording, many recordings, a file, or a study jointly.

The estimation methods are in `etid.estimators`.
"""
