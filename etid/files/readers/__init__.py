"""Readers of files of other formats, a module each.

A reader is a context manager `opened(path, folder)`: the file's `Contents`, until it is left.  It
may put temporary files into `folder`.
"""
