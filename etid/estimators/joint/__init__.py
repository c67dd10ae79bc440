"""Joint maximum likelihood of many loads that share one driver: terms, fit and errors."""
