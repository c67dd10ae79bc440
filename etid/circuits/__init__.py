"""What can be connected to a driver: elements, circuits made of them, and their netlists.

How a circuit is identified does not belong here.
"""
