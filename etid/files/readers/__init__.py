"""Readers for files of other formats, one module per format.

A reader is a context manager `opened(path, folder)` that returns the `Contents` of the file. It may
create temporary files in `folder`.

`etid.files.formats` declares the formats and names the reader of each.
"""
