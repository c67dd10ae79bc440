"""Limits of what is read from files, all checked before anything is allocated.

A file says how much it holds before it shows it, and a damaged one says anything. None of these
limits is near what a laboratory records; a file beyond one is refused with the limit in the error.
"""

SAMPLES = 1 << 27  # of one record, 11 minutes at 200 kHz: 1 GB as float64
TRIALS = 1 << 21  # of one stack: each is an object in memory
CHUNK = 1 << 28  # bytes of an HDF5 chunk, which is unpacked as a whole
FREE = 1 << 24  # bytes that may be declared whatever is stored,
FREE_TRIALS = 10_000  # and trials
# Bytes declared for each byte stored, above FREE. Converter codes shrink by less than 10; deflate
# could reach 1032 only with samples that are all equal.
COMPRESSION = 100
DEPTH = 50  # groups inside each other, or tables and lists of a mapping; Python's stack bears 1000
LINKS = 20  # soft links that lead from one to the next
ATTRIBUTES = 1000  # of one group or dataset; the schema has 13
ATTRIBUTE = 1 << 24  # bytes of one attribute: labels of TRIALS trials
COLUMNS = 1000  # of a table
MAPPING = 1 << 22  # bytes of a mapping file
FITS = 1 << 24  # rows of a file of fits
