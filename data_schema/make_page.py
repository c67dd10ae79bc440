"""Write `recording-1.json` and `README.md`: `python data_schema/make_page.py`.

Both come from `etid.recordings.schema`, which takes the fields of a recording from
`etid.recordings.fields`. The page adds the formats of `etid.files.formats`, rules and examples.
"""

import json
import pathlib

from etid.files import formats
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

An etid file is an HDF5 file with recordings of a stimulator's output voltage: unloaded (`v_th`) and
with a load (`v_out`), sampled by one clock. Every group with the attribute `kind`, at any depth, is
a recording or a stack of trials. The trials of a stack differ only in their samples and the label
`trial`. `recording-1.json` contains the same table for programs.

```
study.h5                     schema="etid/recording", schema_version="1.0"
├── calibration/98k8         kind="calibration", r_load=98800, sample_rate=200000, pulse_rate=60
│   ├── v_th (time,)         unit="volt", conversion=0.0057
│   └── v_out (time,)        unit="volt", conversion=0.0057
└── s01/dry                  kind="loaded", subject="s01", calibration="calibration/98k8", …
    ├── v_th (time,)         one unloaded record for all trials, or (trial, time)
    └── v_out (trial, time)  read as the recordings s01/dry/0, s01/dry/1, …
```

## Write a file

```python
{EXAMPLE}```

`etid check study.h5` lists the faults of each field of a file. `example.h5` contains a calibration
and five trials. `python data_schema/make_example.py data_schema/example.h5` made it.
"""

_RULES = """\
## Reading rules

- The value of a sample is `conversion · stored + offset` in `unit`, as in NWB's TimeSeries. Store
  converter codes as integers: etid then knows the step of the converter, and nothing is rounded.
- Row `t` of a stacked group `g` is the recording `g/t`. Rows are trials, columns are time. etid
  transposes nothing. A calibration group contains one recording. No recording lies inside another.
- Recordings are sorted by path, and numbers in a path by value: `s2` comes before `s10`.
- `v_th`, `v_out` and `current` may be hard or soft links to a dataset of the same file, for example
  to an unloaded record that several groups share. External links, external storage and virtual
  datasets are refused, because a file must be complete. Soft links to groups are not followed.
- `NaN` is a missing sample. Samples are never complex.
- Unknown attributes, datasets and groups are ignored. If such a name is almost the name of an
  absent field (`samplerate`), etid reports it and does not guess.
- A recording that breaks a rule is left out and listed in `Study.problems`. The others are read.
- Text is UTF-8. An array of one element counts as a scalar.
- etid writes text of fixed length and opens files with `libver="v108"`. Checksums then protect
  everything except the samples, so damage is an error. etid also reads text of variable length,
  the default of h5py. No checksum protects such text: damage may change it without an error.
- A record has at most 2^27 samples, a stack at most 2^21 trials, a path at most 50 groups. A
  dataset that is declared but not stored is refused (`etid/recordings/limits.py`).
- A file of a newer minor version is read. A file of another major version is refused.

etid writes the same layout. Recordings `g/0 … g/T-1` that differ only in samples and `trial` become
one stacked group `g`. Every other recording becomes its own group.
"""


OTHER_FORMATS = """\
## Other formats

`etid import FILE -o study.h5 --mapping FILE.toml` converts a file of an instrument to an etid
file. It prints which channel, unit, scale and rate it used for each signal. Nothing is guessed. A
channel, unit or rate that neither the file nor the mapping gives is an error, and the error lists
the channels of the file. A contradiction between file and mapping is an error too, and one inside
the file: two units or sample rates of one channel, rows of a table with different numbers of cells,
fewer samples than the file declares. If the file may be incomplete, but not certainly, a note is
printed: an oscilloscope's preamble declares more samples than the table has rows, or a table ends
inside a number. If several files are imported into one, each `[[recording]]` has the key `file`:
the name of its file without the folder. A recording without a `path` is then named by its file, as
in `loaded/finger`.

FORMATS

In all formats a name such as `open [mV]`, `open (mV)` or `open / mV` contains a unit.
Columns of one name tell their place: `CH1#2` and `CH1#4` are the second and the fourth column.

The import keeps only a part of a record in memory. MATLAB files before version 7.3, `.npz` files
and records that are split are the exceptions. Integer codes stay integers if a straight line
converts them to volts.

A mapping is TOML. Each `[[recording]]` is a recording or a stack of trials. Keys above the first
`[[recording]]` hold for all of them. The keys are:

- `v_th`, `v_out`: unloaded output, and output with the load. Each is a table with these keys:
    - `channel`: its name in the file; `FILE:NAME` is channel `NAME` of another file, whose path
      begins in the folder that is imported, or in the current one. With a pattern such as
      `CH{electrode}` for `v_out`, each channel that matches becomes the recording of an electrode,
      `path/1`, `path/2`, …;
    - `unit` of its values: `V`, `A` or `s`, with the prefix `k`, `m`, `u` or `µ`, `n`, `p`, or in
      words; needed unless the file contains it;
    - `scale` of this channel alone;
    - `rows`: the trials to use, a number or a list, counted from 0; all trials if absent. A single
      row of `v_th` is the unloaded record of all trials.
- `current`: measured current through the load, a table with the same keys. Optional. It may be
  recorded as a voltage, with a `scale` in volts per ampere.
- `time`: times of a uniform clock, a table with the same keys, instead of `sample_rate`.
- `sample_rate` [Hz]: needed unless the file contains it. It may differ from the rate in the file by
  100 ppm, and then replaces it.
- `pulse_rate` [Hz].
- `scale`: the values of `v_th` and `v_out` divided by this are volts at the terminal. Give 1 if
  they are already volts at the terminal.
- `split`: one long record becomes several trials. `"pulses"` splits it at the pauses between its
  pulses, the name of a trigger channel at the rising edges of the trigger. A trial then has the
  pulses from one edge to the next, up to the first pause.
- `electrode`: as below; and where the electrodes of an array fire in turn within one long record,
  a list of their names in this order, with `split`. Each electrode then becomes the recordings
  `path/E7/0`, `path/E7/1`, ….
- `path` of the recording in the etid file. Several trials become `path/0`, `path/1`, …. Without a
  path, a single `[[recording]]` becomes `loaded/0`, …, or with `r_load` `calibration/0`, ….
- FIELDS: as in the tables above. `r_load` may be
  a text such as `"98k8"`. `trial` may be a list with one label per trial. `calibration` may
  name the `path` of a `[[recording]]` above it that becomes several calibrations: a recording gets
  that of its own electrode, or all if they are trials of one.

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

For one recording, the command line is enough. Its values are in volts, amperes and seconds unless
the file contains other units:

```
etid import table.csv -o study.h5 --v-th open --v-out skin --time t --pulse-rate 60 --scale 0.0535
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
v_th = {channel = "ch0", rows = 0}
v_out = {channel = "ch0", rows = [1, 2]}
```

### NumPy

```toml
# Converter codes (trial, time): 100 of them are 1 V at the terminal.
sample_rate = 200e3
pulse_rate = 60.0
scale = 100.0
v_th = {channel = "open", unit = "V"}

[[recording]]
path = "calibration/98k8"
r_load = 98.8e3
v_out = {channel = "resistor", unit = "V"}

[[recording]]
path = "loaded"
calibration = "calibration/98k8"
v_out = {channel = "skin", unit = "V"}
```
"""


def as_markdown() -> str:
    """The page `README.md`."""
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
    return "\n".join(
        [
            *parts,
            _RULES,
            OTHER_FORMATS.replace("FIELDS", names).replace("FORMATS", formats.as_table()),
        ]
    )


def write(folder: pathlib.Path) -> None:
    """Write `recording-1.json` and `README.md` into a folder."""
    (folder / "recording-1.json").write_text(schema.as_json(), encoding="utf-8")
    (folder / "README.md").write_text(as_markdown(), encoding="utf-8")


if __name__ == "__main__":
    write(pathlib.Path(__file__).parent)
