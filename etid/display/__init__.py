"""A running display: tracked and controlled pulse by pulse, and shown on a page that can stop it.

```python
import etid.display

tracker = etid.display.Tracker.of(driver, calibration, electrodes=98)
```

Everything that belongs to a stream of pulses is here. No other package of etid imports this one.
The public names are those of `etid/display/__init__.pyi`; each is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
