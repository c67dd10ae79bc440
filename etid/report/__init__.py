"""The page about a study, and its tables, figures and words for a methods section."""
