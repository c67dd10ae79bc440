"""Make example.h5, the recordings of the start page: a known resistor, dry skin and damp skin.

python data_schema/make_example.py data_schema/example.h5
"""

import sys

import etid

TRIALS = {"dry": ("01", "02", "03"), "damp": ("01", "02")}


def main(target: str) -> None:
    """Simulate the recordings and write them.

    Args:
        target: The file.
    """
    dry = etid.scenes.paper_dry(snr_db=60.0).simulate(seed=0)
    damp = etid.scenes.paper_damp(snr_db=60.0).simulate(seed=1)
    of = {"dry": dry, "damp": damp}
    trials = [
        of[skin][f"typical/{skin}/{each}"] for skin, names in TRIALS.items() for each in names
    ]
    etid.Study.from_recordings([dry["calibration/98k8"], *trials]).write(target)


if __name__ == "__main__":
    main(sys.argv[1])
