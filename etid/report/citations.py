"""Citations as BibTeX.

The entries come from `citations.bib` and are printed unchanged, except for the version of etid. The
fields of an entry are not parsed.
"""

import importlib.metadata
import importlib.resources
import re
from collections.abc import Iterable


def entries() -> dict[str, str]:
    """All entries of the file by key, in the order of the file."""
    text = (importlib.resources.files("etid.report") / "citations.bib").read_text("utf-8")
    return {key: entry for entry, key in re.findall(r"(?ms)^(@\w+\{(\w+),$.*?^\})", text)}


def bibtex(keys: Iterable[str]) -> str:
    """The BibTeX entries with these keys, in the order of the file.

    Raises:
        KeyError: The file has no entry with one of the keys.
    """
    known, wanted = entries(), set(keys)
    unknown = wanted - known.keys()
    if unknown:
        raise KeyError(f"citations.bib has no entry {', '.join(sorted(unknown))}")
    text = "\n\n".join(entry for key, entry in known.items() if key in wanted)
    return text.replace("{VERSION}", f"{{{importlib.metadata.version('etid')}}}")
