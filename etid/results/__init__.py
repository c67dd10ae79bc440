"""What an identification returns: verdicts, fits, drivers, and the file that keeps them.

How they are found does not belong here.
"""
