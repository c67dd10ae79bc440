"""Circuit identification from electro-tactile stimulation recordings.

```python
import jax
jax.config.update("jax_enable_x64", True)
import etid

driver = etid.identify_driver(calibration)          # a known resistor in place of the skin
fit = etid.identify_skin(recording, driver)
print(fit)
```
"""

import importlib
from typing import TYPE_CHECKING, Any

from etid import scenes as scenes
from etid.batch import identify_skins as identify_skins
from etid.batch import identify_study as identify_study
from etid.bounds import Bound as Bound
from etid.bounds import bound as bound
from etid.circuits import AbstractCircuit as AbstractCircuit
from etid.circuits import Resistor as Resistor
from etid.circuits import SkinRC as SkinRC
from etid.circuits import parameter as parameter
from etid.driver import Driver as Driver
from etid.elements import capacitor as capacitor
from etid.elements import cole as cole
from etid.elements import constant_phase as constant_phase
from etid.elements import parallel as parallel
from etid.elements import resistor as resistor
from etid.elements import series as series
from etid.hdf5 import check as check
from etid.hdf5 import read as read
from etid.identify import identify_driver as identify_driver
from etid.identify import identify_samples as identify_samples
from etid.identify import identify_skin as identify_skin
from etid.identify import predict as predict
from etid.impedance import identify_impedance as identify_impedance
from etid.joint import identify_jointly as identify_jointly
from etid.netlist import circuit_string as circuit_string
from etid.netlist import netlist as netlist
from etid.online import Tracker as Tracker
from etid.plotting import plot as plot
from etid.recording import Recording as Recording
from etid.recording import RecordingError as RecordingError
from etid.recording import Samples as Samples
from etid.results import Fit as Fit
from etid.results import Fits as Fits
from etid.results import IdentificationError as IdentificationError
from etid.streaming import fit_file as fit_file
from etid.study import Study as Study
from etid.study_fits import StudyFits as StudyFits
from etid.verdicts import RESULTS as RESULTS

if TYPE_CHECKING:
    from etid.exporting import export_circuit as export_circuit
    from etid.exporting import export_fits as export_fits
    from etid.exporting import export_study as export_study
    from etid.importing import import_file as import_file
    from etid.study_report import write_report as write_report

# Files of others and reports are imported when they are first used: a fit needs none of them.
_LATER = {
    "export_circuit": "etid.exporting",
    "export_fits": "etid.exporting",
    "export_study": "etid.exporting",
    "import_file": "etid.importing",
    "write_report": "etid.study_report",
}

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_LATER[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LATER})
