"""One load, recorded at several amplitudes."""
