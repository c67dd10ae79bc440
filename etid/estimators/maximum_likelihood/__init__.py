"""Maximum likelihood on the harmonics: the terms, a driver, and a load given its driver."""
