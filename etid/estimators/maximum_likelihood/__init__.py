"""Maximum likelihood on the harmonics: terms, fit of a driver, and fit of a load."""
