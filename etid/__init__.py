"""Circuit identification from electro-tactile stimulation recordings."""
