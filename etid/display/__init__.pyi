"""What etid.display offers, for type checkers; each name is imported when it is first used."""

from .controller import Controller as Controller
from .tracker import Tracker as Tracker

__all__: list[str]
