"""What pyright knows of a fit; pyright reads this file, nothing runs it."""

from typing import assert_type

import etid


def fits(recording: etid.Recording, driver: etid.Driver) -> None:
    """The circuit of a fit has the class that was asked for, with its elements."""
    skin = etid.identify_skin(recording, driver)
    assert_type(skin.circuit, etid.SkinRC)
    assert_type(skin.stderr, etid.SkinRC)
    void = skin.circuit.r_s, skin.circuit.f_c
    assert_type(skin.posterior().draws, etid.SkinRC)
    one = etid.identify_skin(recording, driver, circuit=etid.Resistor())
    assert_type(one.circuit, etid.Resistor)
    void = one.circuit.r, one.stderr.r
    many = etid.identify_skins([recording], driver, circuit=etid.SkinCole())
    assert_type(many[0].circuit, etid.SkinCole)
    void = many.usable().circuit.alpha
    print(void)
    chosen = etid.identify_skin(recording, driver, circuit="auto")
    assert_type(chosen.circuit, etid.AbstractCircuit)
