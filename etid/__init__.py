"""Circuit identification from electro-tactile stimulation recordings.

```python
import etid

driver = etid.identify_driver(calibration)          # a known resistor in place of the skin
fit = etid.identify_skin(recording, driver)
print(fit)
```
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

from etid.garbage import unsearched

if TYPE_CHECKING:
    from etid.files.exporting import export_circuit as export_circuit
    from etid.files.exporting import export_fits as export_fits
    from etid.files.exporting import export_study as export_study
    from etid.files.importing import import_file as import_file
    from etid.files.measured_impedance import read_impedance as read_impedance
    from etid.public import *  # noqa: F403 - it states its names in `__all__`
    from etid.report.study import write_report as write_report

__version__ = "0.1.0"

# Files of others and reports are imported when they are first used: a fit needs none of them.
_LATER = {
    "export_circuit": "etid.files.exporting",
    "export_fits": "etid.files.exporting",
    "export_study": "etid.files.exporting",
    "import_file": "etid.files.importing",
    "read_impedance": "etid.files.measured_impedance",
    "write_report": "etid.report.study",
}


# The import of JAX and of all layers takes a second: a command must first be able to handle Ctrl-C.
# Each name is looked up once, and is then a name of this module.
def __getattr__(name: str) -> Any:
    if name == "__all__":
        return [*_public().__all__, *_LATER, "__version__"]
    if name in _LATER:
        globals()[name] = getattr(importlib.import_module(_LATER[name]), name)
    elif not name.startswith("__") and name in _public().__all__:
        globals()[name] = getattr(_public(), name)
    if name in globals():  # also a package of etid, which `public` has imported
        return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__getattr__("__all__"))


def _public() -> Any:
    if "etid.public" not in sys.modules:
        with unsearched():
            importlib.import_module("etid.public")
    return sys.modules["etid.public"]
