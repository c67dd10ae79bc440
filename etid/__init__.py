"""Circuit identification from electro-tactile stimulation recordings.

```python
import etid

driver = etid.identify_driver(calibration)          # a known resistor in place of the skin
fit = etid.identify_skin(recording, driver)
print(fit)
```

The public names are those of `etid/__init__.pyi`. Each is imported when it is first used: JAX and
all layers take a second, a command must first be able to handle Ctrl-C, and a fit needs neither
readers of other files nor reports.
"""

from typing import Any

import lazy_loader

from etid.garbage import unsearched

__version__ = "0.1.0"

_imported, _, _names = lazy_loader.attach_stub(__name__, __file__)
__all__ = sorted([*_names, "__version__"])  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    with unsearched():
        found = globals()[name] = _imported(name)
    return found


def __dir__() -> list[str]:
    return __all__
