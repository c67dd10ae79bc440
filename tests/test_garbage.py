"""The search for garbage, which waits while many objects are made that live on."""

import gc

import pytest

from etid.garbage import MANY, unsearched


def searches():
    return sum(generation["collections"] for generation in gc.get_stats())


def test_many_new_objects_are_not_searched_and_what_is_frozen_stays_frozen():
    with unsearched():
        kept = [[] for _ in range(2 * MANY)]
        assert not gc.isenabled()
        before = searches()
    assert gc.isenabled()
    assert gc.get_count()[0] < MANY  # they count as old ones
    assert searches() == before
    gc.freeze()
    try:
        frozen = gc.get_freeze_count()
        with unsearched():
            kept += [[] for _ in range(2 * MANY)]
        # Undone it would be 0; a few frozen objects may die.
        assert gc.get_freeze_count() > 0.9 * frozen
    finally:
        gc.unfreeze()


def test_after_an_error_the_search_goes_on():
    with pytest.raises(KeyboardInterrupt), unsearched():
        raise KeyboardInterrupt
    assert gc.isenabled()
