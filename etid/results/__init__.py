"""Results of an identification: verdicts, fits, drivers, and the files that store them.

Code that identifies does not belong here.
"""
