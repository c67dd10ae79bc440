"""Rules of selection: which circuit, driver order and nuisances a scene needs.

A rule compares candidates that others have fitted. It reads no recording and compiles nothing:
`etid.identify` fits the candidates and asks a rule which of them the data support.
"""
