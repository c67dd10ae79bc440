"""How much R_p varies between people, their days and recordings, beyond the errors of the fits."""

import jax
import numpy as np

import etid

jax.config.update("jax_enable_x64", True)
draw = np.random.default_rng(0).normal
trials = []
for subject in range(8):
    of_subject = draw(scale=0.4)
    for session in range(2):
        of_session = draw(scale=0.1)
        for number in range(3):
            r_p = 186e3 * np.exp(of_subject + of_session + draw(scale=0.01))
            labels = {"subject": f"s{subject}", "session": f"d{session}"}
            path = f"s{subject}/d{session}/{number}"
            trials.append(etid.scenes.Trial(path, etid.SkinRC(33e3, r_p, 0.12e-9), **labels))
calibration = etid.scenes.paper_dry().calibration
scene = etid.scenes.Scene(tuple(trials), calibration, samples=10_000, snr_db=50.0)
fits = etid.identify_study(scene.simulate(seed=0)).fits
found = etid.variation(fits, "r_p", by=("subject", "session"))
print(found)
for level, part in found.between.items():
    print(f"{level}: {part.std:.3f}, 95 % from {part.low:.3f} to {part.high:.3f}")
