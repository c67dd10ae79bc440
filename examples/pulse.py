"""The on-line fit as a function: one pulse of all electrodes, state in, state out."""

import numpy as np

import etid
import etid.display

long = etid.scenes.paper_dry(snr_db=60.0, samples=40_000).simulate(seed=0)
driver = etid.identify_driver(long["calibration/98k8"])
tracker = etid.display.Tracker.of(driver, long["calibration/98k8"], electrodes=10)
pulses = tracker.pulses(np.stack([one.v_out for one in long.loaded.recordings()]))
state = tracker.start()
for number, v_out in enumerate(pulses, 1):
    state = tracker.update(state, v_out)
    fit = tracker.read(state)[0]
    if number in (1, 4, 12):
        print(f"after {number} pulses: R_s {fit.circuit.r_s:.0f} ± {fit.stderr.r_s:.0f} ohm")
