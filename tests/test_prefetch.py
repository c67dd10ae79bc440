"""Reading ahead: in order, bounded, one thread, and errors where they belong."""

import threading

import pytest

import etid
from etid.identify import study as of_study
from etid.identify.options import Options
from etid.identify.planning import prefetch
from etid.simulation.scenes import Scene, Trial
from etid.simulation.transformer import ResistorLoad, SkinLoad

WAIT = 10.0  # seconds, of a test that would fail


class Loader:
    """Doubles its argument, refuses some, and remembers who called when."""

    def __init__(self, bad=()):
        self.bad = bad
        self.threads = set()
        self.begun = []
        self.enough = threading.Condition()

    def __call__(self, row):
        with self.enough:
            self.threads.add(threading.get_ident())
            self.begun.append(row)
            self.enough.notify_all()
        if row in self.bad:
            raise ValueError(f"row {row}")
        return 2 * row

    def wait_for(self, count):
        with self.enough:
            assert self.enough.wait_for(lambda: len(self.begun) >= count, WAIT)


def test_an_error_is_that_of_its_row_alone():
    found = []
    for result in prefetch(Loader(bad=(0, 4)), 6, ahead=2):
        try:
            found.append(result())
        except ValueError as error:
            found.append(str(error))
    assert found == ["row 0", 2, 4, 6, "row 4", 10]


def test_it_reads_while_the_caller_computes_but_no_further_than_said():
    load = Loader()
    results = prefetch(load, 100, ahead=3)
    for row, result in enumerate(results):
        assert result() == 2 * row
        load.wait_for(min(row + 4, 100))  # the three next ones, though nobody asked yet
        assert len(load.begun) <= row + 4
        if row == 20:
            break
    results.close()
    assert load.begun == list(range(24))
    assert load.threads.isdisjoint([threading.get_ident()])
    assert not any(thread.name.startswith("prefetch") for thread in threading.enumerate())
    assert list(prefetch(load, 0, ahead=3)) == []


def test_a_driver_is_identified_once_by_threads_that_ask_together(monkeypatch):
    scene = Scene(
        (Trial("loaded/0", SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)),),
        (Trial("calibration/0", ResistorLoad(98.8e3)),),
        samples=2000,
    )
    study = scene.simulate(seed=1)
    together, calls = threading.Barrier(2), []

    def slow(records, *_, **__):
        calls.append(records)
        with pytest.raises(threading.BrokenBarrierError):
            together.wait(0.2)  # the other must not come here
        raise etid.IdentificationError("no driver", None)

    monkeypatch.setattr(of_study, "calibrated", slow)
    drivers = of_study.Drivers(study, Options())
    refused = []

    def ask():
        try:
            drivers.of(study["loaded/0"])
        except etid.IdentificationError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT)
    assert refused == ["no driver", "no driver"]
    assert len(calls) == 1
