"""Published values of the paper: resistors, tables I to IV and RRSE, in SI units and per cent.

*Towards On-line Fingertip Bio-impedance Identification for Enhancement of Electro-tactile
Rendering*. Scenes simulate these values, and `benchmarks.paper` compares its results with them.
"""

from etid.simulation.transformer import SkinLoad

REFERENCE = 98.8e3  # resistor of the calibration [ohm]

# Table I: error [%] of each test resistor [ohm].
TABLE_1 = {21.62e3: 4.26, 55.20e3: 0.42, 216.6e3: 9.6, 328.9e3: 12.2, 555.0e3: 0.25}

# Tables II and III: typical fingertip, lowest and highest value of ten subjects [SI].
FINGERTIPS = {
    "dry": {
        "r_s": (33.4e3, 19e3, 69.8e3),
        "r_p": (186e3, 194e3, 616e3),
        "c_p": (0.12e-9, 45e-12, 165e-12),
    },
    "damp": {
        "r_s": (6.1e3, 3.9e3, 19.8e3),
        "r_p": (17.4e3, 20.2e3, 165e3),
        "c_p": (0.66e-9, 160e-12, 845e-12),
    },
}
TYPICAL = {
    condition: SkinLoad(**{name: values[0] for name, values in elements.items()})
    for condition, elements in FINGERTIPS.items()
}

# Table IV: the soldered circuit; error of the mean, and scatter between 23 trials [%].
BUILT = SkinLoad(r_s=32.46e3, r_p=179.8e3, c_p=0.12e-9)
TABLE_4 = {"r_p": (2.46, 17.5), "c_p": (10.4, 26.9), "r_s": (15.5, 43.2)}

RRSE = (4, 13)  # lowest and highest [%]
