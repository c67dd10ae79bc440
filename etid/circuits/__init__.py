"""Loads of a driver: elements, circuits that are built from elements, and their netlists.

Code that identifies a circuit does not belong here.
"""
