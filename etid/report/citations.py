"""What to cite, as BibTeX."""

import importlib.metadata
from collections.abc import Iterable

_ENTRIES = {
    "etid": """@software{etid,
  author  = {{The etid authors}},
  title   = {etid: circuit identification from electro-tactile stimulation recordings},
  version = {VERSION},
}""",
    # Authors and venue are left to the reader, who has the paper before them.
    "fingertip": """@misc{fingertip,
  title = {Towards On-line Fingertip Bio-impedance Identification for Enhancement of
           Electro-tactile Rendering},
}""",
    "steiglitz1965": """@article{steiglitz1965,
  author  = {Steiglitz, Kenneth and McBride, Lawrence E.},
  title   = {A technique for the identification of linear systems},
  journal = {IEEE Transactions on Automatic Control},
  volume  = {10},
  number  = {4},
  pages   = {461--464},
  year    = {1965},
  doi     = {10.1109/TAC.1965.1098181},
}""",
    "pintelon2012": """@book{pintelon2012,
  author    = {Pintelon, Rik and Schoukens, Johan},
  title     = {System Identification: A Frequency Domain Approach},
  edition   = {2},
  publisher = {Wiley-IEEE Press},
  year      = {2012},
  doi       = {10.1002/9781118287422},
}""",
    "ljung1999": """@book{ljung1999,
  author    = {Ljung, Lennart},
  title     = {System Identification: Theory for the User},
  edition   = {2},
  publisher = {Prentice Hall},
  year      = {1999},
}""",
    "soderstrom2007": """@article{soderstrom2007,
  author  = {S{\\"o}derstr{\\"o}m, Torsten},
  title   = {Errors-in-variables methods in system identification},
  journal = {Automatica},
  volume  = {43},
  number  = {6},
  pages   = {939--958},
  year    = {2007},
  doi     = {10.1016/j.automatica.2006.11.025},
}""",
    "white1980": """@article{white1980,
  author  = {White, Halbert},
  title   = {A heteroskedasticity-consistent covariance matrix estimator and a direct test for
             heteroskedasticity},
  journal = {Econometrica},
  volume  = {48},
  number  = {4},
  pages   = {817--838},
  year    = {1980},
  doi     = {10.2307/1912934},
}""",
    "jax2018": """@software{jax2018,
  author = {James Bradbury and Roy Frostig and Peter Hawkins and Matthew James Johnson and
            Chris Leary and Dougal Maclaurin and George Necula and Adam Paszke and
            Jake Vander{P}las and Skye Wanderman-{M}ilne and Qiao Zhang},
  title  = {{JAX}: composable transformations of {P}ython+{N}um{P}y programs},
  url    = {https://github.com/jax-ml/jax},
  year   = {2018},
}""",
    "optimistix2024": """@article{optimistix2024,
  author  = {Rader, Jason and Lyons, Terry and Kidger, Patrick},
  title   = {Optimistix: modular optimisation in {JAX} and {Equinox}},
  journal = {arXiv:2402.09983},
  year    = {2024},
}""",
}


def bibtex(keys: Iterable[str]) -> str:
    """The BibTeX entries of some keys, in the order in which the dictionary of all has them."""
    wanted = set(keys)
    unknown = wanted - _ENTRIES.keys()
    if unknown:
        raise KeyError(f"nothing is known of {', '.join(sorted(unknown))}")
    text = "\n\n".join(entry for key, entry in _ENTRIES.items() if key in wanted)
    return text.replace("{VERSION}", f"{{{importlib.metadata.version('etid')}}}")
