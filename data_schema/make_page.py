"""Write the schema for machines and for people: `python data_schema/make_page.py`.

Both are made from `etid.recordings.schema`, which takes the fields of a recording from
`etid.recordings.fields`; the page for people adds examples.
"""

import json
import pathlib

from etid.recordings import schema
from etid.recordings.fields import DECLARED

EXAMPLE = """\
import h5py
import numpy as np

pulse = np.tile(np.r_[np.zeros(3200, "i2"), np.full(133, 9000, "i2")], 3)  # three periods
volts_per_code = 20 / 2**16 / 0.0535  # 20 V over 16 bits, behind a scale of 0.0535

with h5py.File("study.h5", "w") as file:
    file.attrs.update(schema="etid/recording", schema_version="1.0")
    known = file.create_group("calibration/98k8")
    known.attrs.update(kind="calibration", sample_rate=200e3, pulse_rate=60.0, r_load=98.8e3)
    skin = file.create_group("s01/dry")
    skin.attrs.update(kind="loaded", sample_rate=200e3, pulse_rate=60.0, subject="s01")
    skin.attrs.update(condition="dry", calibration="calibration/98k8", trial=[0, 1, 2])
    for group, loaded in (known, pulse // 2), (skin, np.stack([pulse // 3] * 3)):
        for name, codes in ("v_th", pulse), ("v_out", loaded):
            group[name] = codes
            group[name].attrs.update(unit="volt", conversion=volts_per_code)
"""

_INTRODUCTION = f"""\
# Data schema {schema.VERSION}

<!-- made from etid/recordings/fields.py and schema.py by `python data_schema/make_page.py` -->

An etid file is an HDF5 file with recordings of a stimulator's output: unloaded (`v_th`) and with a
load (`v_out`), on one clock. Every group, at any depth, with the attribute `kind` is a recording,
or a stack of trials that differ in nothing but their samples and the label `trial`.
`recording-1.json` holds the same table for machines.

```
study.h5                     schema="etid/recording", schema_version="1.0"
├── calibration/98k8         kind="calibration", r_load=98800, sample_rate=200000, pulse_rate=60
│   ├── v_th (time,)         unit="volt", conversion=0.0057
│   └── v_out (time,)        unit="volt", conversion=0.0057
└── s01/dry                  kind="loaded", subject="s01", calibration="calibration/98k8", …
    ├── v_th (time,)         one unloaded record for all trials, or (trial, time)
    └── v_out (trial, time)  read as the recordings s01/dry/0, s01/dry/1, …
```

## Write one

```python
{EXAMPLE}```

`etid check study.h5` says what is wrong with a file, field by field. `example.h5` is a file with a
calibration and a stack of three trials; `python data_schema/make_example.py data_schema/example.h5`
made it.
"""

_RULES = """\
## Reading rules

- The value of a sample is `conversion · stored + offset` in `unit`, as in NWB's TimeSeries. Store
  converter codes as integers: their step is then known, and nothing is rounded.
- Row `t` of a stacked group `g` is the recording `g/t`. Rows are trials, columns are time; nothing
  is transposed. A calibration group holds one recording, and no recording lies inside another.
- Recordings come in the order of their paths, numbers in them by value: `s2` before `s10`.
- `v_th`, `v_out` and `current` may be hard or soft links to a dataset of the same file, for example
  to an unloaded record that several groups share. External links, external storage and virtual
  datasets are refused: a file is whole. Groups are not reached through soft links.
- `NaN` is a missing sample. Samples are never complex.
- Unknown attributes, datasets and groups are ignored, except where the name is nearly that of an
  absent field (`samplerate`): that is reported, not guessed.
- A recording that breaks a rule is left out and listed in `Study.problems`; the others are read.
- Text is UTF-8. An array of one element counts as a scalar.
- etid writes text of a fixed length and opens files with `libver="v108"`: all but the samples is
  then under checksums, and damage is an error. Text of variable length, h5py's default, is read
  too, but no checksum protects it: damage inside it may be read as another text.
- A record has at most 2^27 samples, a stack 2^21 trials, a path 50 groups; what is declared but not
  stored is refused (`etid/recordings/limits.py`).
- A file of a newer minor version is read, one of another major version is refused.

What etid writes is the same layout: recordings `g/0 … g/T-1` that differ in nothing but samples and
trial become one stacked group `g`, every other recording a group of its own.
"""


OTHER_FORMATS = """\
## Other formats

`etid import FILE study.h5 --mapping FILE.toml` turns a file of an instrument into an etid file, and
prints which channel, unit, scale and rate it took for what. Nothing is guessed: a channel, unit or
rate that neither the file nor the mapping says is an error, which lists the channels that there
are; so is what both say differently.

| file | channels | the file says | trials | install |
|---|---|---|---|---|
| `.csv` | columns, by the first line | units: `open [mV]`, or a second line of them | none | |
| `.mat` | variables, `a.b` for field b of structure a | nothing | rows | `etid[matlab]` |
| `.tdms` | `group/channel` | units (`unit_string`), rate (`wf_increment`) | none | `etid[tdms]` |
| `.abf` | ADC channels, or `channel 0`, … | units and rate | sweeps | `etid[abf]` |

At most a part of a record is in memory; only MATLAB files before version 7.3 are read whole, and
only they need `etid[matlab]`. Integer codes stay integers where a line makes volts of them.

A mapping is TOML. Each `[[recording]]` is a recording or a stack of trials, and what stands above
the first one holds for all. Its keys:

- `v_th`, `v_out`: unloaded output, and output with the load, each a table of
    - `channel`: its name in the file;
    - `unit` of its values: `V`, `A` or `s`, with `k`, `m`, `u` or `µ`, `n`, `p`, or in words;
      needed unless the file says it;
    - `scale` of this channel alone;
    - `rows`: which of its trials, a number or a list, from 0 on; without it all. A single row of
      `v_th` is the unloaded record of all trials.
- `current`: measured current through the load, such a table too; with a `scale` in volts per ampere
  it may be recorded as a voltage. Optional.
- `time`: times of a uniform clock, such a table too, instead of `sample_rate`.
- `sample_rate` [Hz]: needed unless the file says it. The two may differ by 100 ppm; this one
  holds.
- `pulse_rate` [Hz].
- `scale`: volts at the terminal are the values of `v_th` and `v_out` divided by this; 1 if they are
  the same.
- `path` of the recording in the etid file. Several trials become `path/0`, `path/1`, …; without a
  path, a single `[[recording]]` becomes `loaded/0`, … or, with `r_load`, `calibration/0`, ….
- FIELDS: as above; `trial` may be a list with a label per trial.

### CSV

```text
t (ms),open (mV),skin (mV)
0.000,1.25,1.25
0.005,2.50,1.75
0.010,2.25,1.50
```

```toml
pulse_rate = 60.0
scale = 0.0535
time = {channel = "t"}

[[recording]]
path = "s01/dry"
subject = "s01"
condition = "dry"
v_th = {channel = "open"}
v_out = {channel = "skin"}
```

For one recording the command line is enough; there, values are in volts, amperes and seconds unless
the file says otherwise:

```
etid import table.csv study.h5 --v-th open --v-out skin --time t --pulse-rate 60 --scale 0.0535
```

### MATLAB

```matlab
known = struct('open', v1, 'loaded', v2);  % 1 x time, in volts
dry = struct('open', v3, 'skin', v4);      % 1 x time, and trials x time
save('session.mat', 'known', 'dry', '-v7.3')
```

```toml
sample_rate = 200e3
pulse_rate = 60.0
scale = 0.0535

[[recording]]
path = "calibration/98k8"
r_load = 98.8e3
v_th = {channel = "known.open", unit = "V"}
v_out = {channel = "known.loaded", unit = "V"}

[[recording]]
path = "s01/dry"
calibration = "calibration/98k8"
v_th = {channel = "dry.open", unit = "V"}
v_out = {channel = "dry.skin", unit = "V"}
```

### TDMS

```toml
pulse_rate = 60.0
scale = 0.0535

[[recording]]
path = "calibration/98k8"
r_load = 98.8e3
v_th = {channel = "known/open"}
v_out = {channel = "known/loaded"}

[[recording]]
path = "s01/dry"
calibration = "calibration/98k8"
subject = "s01"
condition = "dry"
v_th = {channel = "s01 dry/open"}
v_out = {channel = "s01 dry/skin"}
current = {channel = "s01 dry/shunt", scale = 100.0}  # volts over 100 ohm
```

### ABF

```toml
# Sweep 0 was recorded without the finger, sweeps 1 and 2 with it.
pulse_rate = 60.0
scale = 0.0535

[[recording]]
path = "s01/dry"
v_th = {channel = "channel 0", rows = 0}
v_out = {channel = "channel 0", rows = [1, 2]}
```

### NumPy

A `.npz` archive with the converter codes `adc_th`, `adc_out` (trial, time) and `adc_ref` (resistor,
time), and with `R_ref`, `fs`, `f0`, `lsb` and `scale`, says everything itself: it has no mapping.
"""


def as_markdown() -> str:
    """The table for people."""
    titles = {
        "file attribute": "Attributes of the file",
        "group attribute": "Attributes of a recording's group",
        "dataset": "Datasets of a recording's group",
        "dataset attribute": "Attributes of a dataset",
    }
    parts = [_INTRODUCTION]
    for place, title in titles.items():
        lines = [
            f"## {title}",
            "",
            "| name | type | shape | unit | required | meaning | example |",
            "|---|---|---|---|---|---|---|",
        ]
        for field in schema.at(place).values():  # type: ignore[arg-type]  # keys of titles are places
            need = field.required + (f", forbidden for {field.forbidden}" * bool(field.forbidden))
            example = json.dumps(field.example)
            lines.append(
                f"| `{field.name}` | {field.type} | {field.shape} | {field.unit} | {need} | "
                f"{field.description} | `{example}` |"
            )
        parts.append("\n".join(lines) + "\n")
    rates = ("sample_rate", "pulse_rate")  # which have lines of their own
    names = ", ".join(f"`{name}`" for name in DECLARED if name not in rates)
    return "\n".join([*parts, _RULES, OTHER_FORMATS.replace("FIELDS", names)])


def write(folder: pathlib.Path) -> None:
    """Write `recording-1.json` and `README.md` into a folder."""
    (folder / "recording-1.json").write_text(schema.as_json(), encoding="utf-8")
    (folder / "README.md").write_text(as_markdown(), encoding="utf-8")


if __name__ == "__main__":
    write(pathlib.Path(__file__).parent)
