"""A circuit of one's own, with a distributed element: a dispersion beside a leak."""

import etid


class Leaky(etid.AbstractCircuit):
    """R_s + Z_Cole ‖ R_leak, the dispersion of Cole with an exponent."""

    r_s: float = etid.parameter("ohm", typical=30e3)
    r_p: float = etid.parameter("ohm", typical=200e3)
    tau: float = etid.parameter("second", typical=20e-6)
    alpha: float = etid.parameter("1", typical=0.9)

    def impedance(self):
        cole = etid.cole(self.r_p, self.tau, self.alpha)
        return etid.series(etid.resistor(self.r_s), etid.parallel(cole, etid.resistor(1e6)))


truth = Leaky(25e3, 150e3, 18e-6, 0.85)
trials = (etid.scenes.Trial("finger", truth),)
calibration = etid.scenes.paper_calibration().calibration
study = etid.scenes.Scene(trials, calibration).simulate(seed=0)
driver = etid.identify_driver(study[calibration[0].path], order=5)
fit = etid.identify_skin(study["finger"], driver, circuit=Leaky())
print(fit)
