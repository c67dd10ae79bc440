"""Every perturbation of the benchmark, by name, and those that nothing can show.

Names: `hum60_0.02V` is a sine at that frequency and amplitude at the converter; `all` means every
record, `skin` those of skin, `out` the loaded voltage. `rp_linear_0.05` lets R_p fall by that part
from the first pulse to the last, `step` after half of the record. `driver_X` changes a part of the
driver between calibration and skin. Delays are in samples of 5 µs. `says` is what the file says and
is not true.
"""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np
import scipy.stats

from benchmarks import perturbed_study as lab
from benchmarks import visibility
from benchmarks.failure_axes import Cole, TwoLayers
from benchmarks.laboratory import hum, leaky, offset, pink, spike
from benchmarks.ladder import ELECTRONICS, LOADS, WHITE
from benchmarks.perturbed_study import Change, all_records, both, calibrations, out, th, trials
from etid.simulation.transformer import ResistorLoad, TransformerDriver

SIX = 20_000  # samples of six periods
# Six periods of 8 bits determine R_s to 8 %: every hundredth good answer is 20 % off.
LENGTHS = {"oscilloscope_8_bit": 2 * SIX}

UNDISTURBED: Mapping[str, Change] = {
    "base": lambda study: study,
    "base_no_delay": lambda study: all_records(both(delay=0.0))(study),
    "base_six_periods": lab.lasting(SIX),
    "base_two_resistors": lab.second_resistor(1.0),
    "base_whole_samples_per_period": lab.coherent(),
    "base_begins_in_a_pulse": lab.beginning(0.3e-3),
    "base_begins_on_the_tail_of_a_pulse": lab.beginning(0.8e-3),
    "base_pulses_of_4_ms": lab.wide(4e-3),
    **{
        f"base_{name}": lab.lasting(LENGTHS.get(name, SIX), lab.instrument(name))
        for name in ELECTRONICS
        if name != WHITE
    },
}
"""Studies in which all is well: hardly any of them may be refused."""


def _hum(amplitude: float) -> dict[str, Change]:
    said = f"{amplitude:g}V"
    return {
        f"hum60_{said}_all": all_records(both(added=(hum(60.0, amplitude),))),
        f"hum60_{said}_out_skin_only": trials(out(added=(hum(60.0, amplitude),))),
        f"hum50_{said}_all": all_records(both(added=(hum(50.0, amplitude),))),
    }


_LOCKED = hum(60.0, 0.02, phase=0.2)
NUISANCES: Mapping[str, Change] = {
    **_hum(0.002),
    **_hum(0.02),
    **_hum(0.1),
    "hum60h_100mV_all": all_records(both(added=(hum(60.0, 0.1, (2, 3, 5)),))),
    "hum60_20mV_phase_locked_th_and_out": all_records(both(added=(_LOCKED,))),
    "dc_0.5V_all": all_records(both(added=(offset(0.5),))),
    "wander1Hz_50mV": all_records(both(added=(hum(1.0, 0.05),))),
    "wander1Hz_500mV": all_records(both(added=(hum(1.0, 0.5),))),
    "spike_0.5V_5ms_out": trials(out(added=(spike(0.5, 5e-3),))),
    "spike_0.1V_5ms_out": trials(out(added=(spike(0.1, 5e-3),))),
    "spike_1V_5ms_out": trials(out(added=(spike(1.0, 5e-3),))),
    "spike_1V_0.1ms_out": trials(out(added=(spike(1.0, 1e-4),))),
    "spike_1V_5ms_out_six_periods": lab.lasting(SIX, trials(out(added=(spike(1.0, 5e-3),)))),
    "spike_0.1V_5ms_th_six_periods": lab.lasting(SIX, trials(th(added=(spike(0.1, 5e-3),)))),
    "jump_0.5V_5ms_out": trials(out(added=(spike(0.5, 5e-3, rectangular=True),))),
    "jump_1V_5ms_out": trials(out(added=(spike(1.0, 5e-3, rectangular=True),))),
    "tail_5mV_5ms": all_records(lab.tail(5e-3, 5e-3)),
    "tail_5mV_5ms_skin": trials(lab.tail(5e-3, 5e-3)),
    "crosstalk_1%_neighbour": trials(lab.neighbour(4e-3)),
    "crosstalk_1%_unloaded": trials(lab.fault("crosstalk", 0.01)),
    "coloured_noise_1/f": all_records(lambda of: both(added=(pink(3 * of.sigma),))(of)),
}

CONVERTERS: Mapping[str, Change] = {
    "bits8_10V": all_records(lab.record(bits=8)),
    "bits8_4V": all_records(lab.record(bits=8, full_scale=4.0)),
    "bits8_4V_nonoise": all_records(lab.record(bits=8, full_scale=4.0, sigma=0.0)),
    "bits8_4V_float": all_records(lab.record(bits=8, full_scale=4.0, codes=False)),
    "bits10_10V_nonoise_float": all_records(lab.record(bits=10, sigma=0.0, codes=False)),
    "whole_samples_per_period_unfiltered": lab.coherent(antialias=4.0),
    **{
        f"bits{bits}_10V_float_no_range": all_records(
            lab.record(bits=bits, codes=False, told={"adc_range": None})
        )
        for bits in (12, 14)
    },
    "three_digits": all_records(lab.record(digits=3, told={"adc_range": None})),
    "out_a_tenth_skin_only": trials(out(gain=0.1)),
    "lowpass_80kHz_skin": trials(out(lowpass=80e3)),
    "lowpass_80kHz_skin_one_period": lab.lasting(3_400, trials(out(lowpass=80e3))),
    "capacitance_5pF_skin": trials(lab.fault("capacitance", 5e-12)),
    "adc_jitter_500ns": all_records(both(sampling_jitter=500e-9)),
    "slow_adc_filter_out": all_records(out(lowpass=30e3)),
    "slow_adc_filter_out_skin_only": trials(out(lowpass=30e3)),
    "gain_out_+1%_all": all_records(lab.fault("gain", 0.01)),
    "gain_out_-1%_all": all_records(lab.fault("gain", -0.01)),
    "gain_out_+1%_skin": trials(lab.fault("gain", 0.01)),
    "gain_out_-1%_skin": trials(lab.fault("gain", -0.01)),
    "gain_-5%_skin": trials(lab.fault("gain", -0.05)),
    "polarity_out": all_records(out(gain=-1.0)),
    "polarity_out_skin_only": trials(out(gain=-1.0)),
    "polarity_both": all_records(both(gain=-1.0)),
    "swapped": all_records(lab.record(swapped=True)),
    "swapped_skin_only": trials(lab.record(swapped=True)),
}

_MISSING = {"pulses": ((0, 1.0), (2, 1.0)), "over": 3}
_DOUBLE = {"pulses": ((0, 1.0), (1, 1.0), (1.5, 1.0), (2, 1.0)), "over": 3}
CLOCKS: Mapping[str, Change] = {
    "missing_pulse_out": trials(out(**_MISSING)),
    "missing_pulse_both": trials(both(**_MISSING)),
    "double_pulse_out": trials(out(**_DOUBLE)),
    "double_pulse_both": trials(both(**_DOUBLE)),
    **{
        f"{fault}_sample_{name}": trials(change(**{fault: 5000}))
        for fault in ("lost", "doubled")
        for name, change in (("out", out), ("th", th))
    },
    "lost_sample_in_pulse_out": trials(out(lost=3420)),
    "lost_sample_out_six_periods": lab.lasting(SIX, trials(out(lost=12_000))),
    "edge_at_the_joint_pulses_jitter": trials(lab.on_edge),
    "clock_out_20ppm": all_records(out(pulse_rate=60.0012)),
    "clock_out_20ppm_skin": trials(out(pulse_rate=60.0012)),
    "rate_0.1%_all": all_records(both(pulse_rate=60.06)),
    "rate_100ppm_all": all_records(both(pulse_rate=60.006)),
    "rate_0.1%_skin_only": trials(both(pulse_rate=60.06)),
    "rate_1%_all": all_records(both(pulse_rate=60.6)),
    **{
        f"delay_{samples:g}_samples_out": all_records(lab.late(samples))
        for samples in (1.5, 5.0, 50.0)
    },
    **{
        f"delay_{samples:g}_samples_skin": trials(lab.late(samples))
        for samples in (0.9, 1.5, 5.0, 50.0, 100.0)
    },
    **{
        f"says_{rate // 1000}kHz": all_records(lab.record(told={"sample_rate": float(rate)}))
        for rate in (50_000, 100_000, 250_000, 400_000)
    },
    "says_100kHz_six_periods": lab.lasting(
        SIX, all_records(lab.record(told={"sample_rate": 100e3}))
    ),
    **{
        f"says_{rate}Hz": all_records(lab.record(told={"pulse_rate": float(rate)}))
        for rate in (20, 30, 50, 90, 120, 180)
    },
    "says_1/60Hz": all_records(lab.record(told={"pulse_rate": 1 / 60})),
}

SKINS: Mapping[str, Change] = {
    **{
        f"{name}_{kind}_{fall:g}": lab.changing(element, fall, kind == "step")
        for fall in (0.05, 0.2)
        for name, element in (("rp", "r_p"), ("rs", "r_s"))
        for kind in ("linear", "step")
    },
    "cp_linear_0.05": lab.changing("c_p", 0.05, False),
    "rp_linear_0.05_six_periods": lab.lasting(SIX, lab.changing("r_p", 0.05, False, 6)),
    "rs_step_0.2_six_periods": lab.lasting(SIX, lab.changing("r_s", 0.2, True, 6)),
    "Rp_nonlinear_0.2": lab.nonlinear(0.2),
    "Rp_nonlinear_0.4": lab.nonlinear(0.4),
    "cole_alpha0.8": lab.skin_is(functools.partial(Cole, alpha=0.8), words=True),
    "two_rc_mid": lab.skin_is(functools.partial(TwoLayers, share=0.3), words=True),
    "leak_100Rp": lab.skin_is(lambda skin: leaky(skin, 100 * skin.r_p)),
    "inductance_5mH_skin": trials(lab.fault("inductance", 5e-3)),
}

_ALL_PARTS = ("r_protection", "r_secondary", "l_secondary", "l_magnetising", "r_source")
DRIVERS: Mapping[str, Change] = {
    "driver_Rprot_x1.05": trials(lab.parts(r_protection=1.05)),
    "driver_Rprot_x1.2": trials(lab.parts(r_protection=1.2)),
    "driver_Rsw_x1.2": trials(lab.parts(r_secondary=1.2)),
    "driver_Lls_x1.05": trials(lab.parts(l_primary=1.05, l_secondary=1.05)),
    "driver_Lls_x1.2": trials(lab.parts(l_primary=1.2, l_secondary=1.2)),
    "driver_Lm_x1.2": trials(lab.parts(l_magnetising=1.2)),
    "driver_Rsrc_x1.2": trials(lab.parts(r_source=1.2)),
    "driver_Csec_x1.1": trials(lab.parts(c_secondary=1.1)),
    "driver_Ccab_x1.1": trials(lab.parts(c_cable=1.1)),
    "driver_all_5%": trials(lab.parts(**dict.fromkeys(_ALL_PARTS, 1.05))),
    "driver_Vp_+2%_out_vs_th": trials(lab.parts("out", amplitude=1.02)),
    "driver_Vp_-2%_out_vs_th": trials(lab.parts("out", amplitude=0.98)),
}

CALIBRATIONS: Mapping[str, Change] = {
    "driver_Rload_wrong_5%": calibrations(out(loads=(ResistorLoad(1.05 * lab.REFERENCE),))),
    "two_resistors_one_wrong_5%": lab.second_resistor(1.05),
    "says_98.8ohm": calibrations(lab.record(told={"r_load": lab.REFERENCE / 1000})),
    "says_1mohm": calibrations(lab.record(told={"r_load": 1e-3})),
    "says_1Tohm": calibrations(lab.record(told={"r_load": 1e12})),
    "calibration_v_out_is_v_th": calibrations(lab.record(copied=True)),
    "calibration_unloaded": calibrations(out(loads=(ResistorLoad(1e15),))),
    "calibration_is_skin": calibrations(out(loads=(LOADS["dry"],))),
}

FAULTS = (NUISANCES, CONVERTERS, CLOCKS, SKINS, DRIVERS, CALIBRATIONS)
PERTURBATIONS: Mapping[str, Change] = {
    name: change for group in (UNDISTURBED, *FAULTS) for name, change in group.items()
}
AND = " + "


def pair(number: int) -> str:
    """Two faults of different groups, drawn at random."""
    rng = np.random.default_rng([number, *b"pair"])
    groups = rng.choice(len(FAULTS), 2, replace=False)
    return AND.join(str(rng.choice(list(FAULTS[group]))) for group in groups)


def change_of(name: str) -> Change:
    """The change that a perturbation is, or a pair of them, one after the other."""
    changes = [PERTURBATIONS[one] for one in name.split(AND)]
    return lambda study: functools.reduce(lambda of, change: change(of), changes, study)


@dataclasses.dataclass(frozen=True)
class Invisible:
    """Why a perturbation is not seen."""

    # as many silent answers are excused as the best test of it would miss
    change: visibility.Change | None = None
    # without a test: the relative error of an element that the perturbation itself makes
    error: float = 0.0

    def excuses(self, path: str, snr_db: float, silent: int, answers: int, beyond: float) -> bool:
        """Whether so many answers behind the skin of this path would be silent for the best test.

        `beyond` is the largest relative error of them beyond what a right answer may have.
        """
        if self.change is None:
            return beyond <= self.error
        missed = visibility.missed(LOADS[path], snr_db, self.change)
        return bool(scipy.stats.binom.sf(silent - 1, answers, missed) > CHANCE)


CHANCE = 0.01  # probability that the best test, too, is silent so often
INVISIBLE: Mapping[str, Invisible] = {
    # Every resistance and 1/C_p: one calibration shows ratios to its resistor only.
    "driver_Rload_wrong_5%": Invisible(error=0.05),
    # It has the impedance of another R_s + R_p ‖ C_p at every frequency; R_p is least.
    "leak_100Rp": Invisible(error=0.017),
    # R_p up to 13 %, and R_p of damp skin up to 6, 6 and 8 %.
    **{f"gain_out_{sign}1%_all": Invisible(visibility.fault("gain", 0.01, True)) for sign in "+-"},
    **{f"gain_out_{sign}1%_skin": Invisible(visibility.fault("gain", 0.01)) for sign in "+-"},
    "crosstalk_1%_unloaded": Invisible(visibility.fault("crosstalk", 0.01)),
    **{f"driver_Vp_{sign}2%_out_vs_th": Invisible(visibility.fault("gain", 0.02)) for sign in "+-"},
    # R_s up to 80 and 40 %, of dry skin up to 6 %.
    "slow_adc_filter_out_skin_only": Invisible(visibility.lowpass(30e3)),
    "lowpass_80kHz_skin": Invisible(visibility.lowpass(80e3)),
    "lowpass_80kHz_skin_one_period": Invisible(visibility.lowpass(80e3)),
    "capacitance_5pF_skin": Invisible(visibility.fault("capacitance", 5e-12)),
    "inductance_5mH_skin": Invisible(visibility.fault("inductance", 5e-3)),
    # R_p up to 4 %.
    "driver_Rprot_x1.05": Invisible(
        visibility.fault("series", 0.05 * TransformerDriver().r_protection)
    ),
}
"""Perturbations that the records show too faintly, or not at all."""
