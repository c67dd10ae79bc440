"""Make example.h5: one calibration and three trials of a dry fingertip, one pulse period each.

python data_schema/make_example.py data_schema/example.h5
"""

import sys

from etid.simulation import scenes
from etid.simulation.transformer import ResistorLoad, SkinLoad


def main(target: str) -> None:
    """Simulate the recordings and write them.

    Args:
        target: The file.
    """
    dry = SkinLoad(r_s=33.4e3, r_p=186e3, c_p=0.12e-9)
    scene = scenes.Scene(
        trials=tuple(
            scenes.Trial(f"s01/dry/{i}", dry, subject="s01", condition="dry", trial=f"{i}")
            for i in range(3)
        ),
        calibration=(scenes.Trial("calibration/98k8", ResistorLoad(98.8e3)),),
        samples=3333,
        snr_db=70.0,
    )
    scene.simulate(seed=0).write(target)


if __name__ == "__main__":
    main(sys.argv[1])
