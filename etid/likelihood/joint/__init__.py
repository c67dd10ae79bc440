"""Joint maximum likelihood of many loads with one driver: terms, fit and standard errors."""
