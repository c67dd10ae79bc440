"""Limits for data from files; they are checked before memory is allocated.

A file declares the size of its data before the data. A damaged file may declare any size. The
limits are far above the sizes of laboratory recordings. If a file exceeds a limit, the error states
the limit.
"""

SAMPLES = 1 << 27  # samples of one record: 11 minutes at 200 kHz, 1 GB as float64
TRIALS = 1 << 21  # trials of one stack: each trial is an object in memory
FREE = 1 << 24  # [bytes] size that may be declared without a check of the stored size
# Declared bytes per stored byte, above FREE. Compression shrinks converter codes by a factor below
# 10. Deflate reaches its maximum of 1032 only if all samples are equal.
COMPRESSION = 100
# Nested groups, or nested tables and lists of a mapping; Python allows 1000 nested calls.
DEPTH = 50
NAMES = 1000  # lines of a matrix that are channels too, elements of a circuit
MAPPING = 1 << 22  # [bytes] size of a mapping file
FITS = 1 << 24  # rows of a file of fits
