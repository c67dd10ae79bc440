"""The report on a study: an HTML page with tables, figures and a methods section."""
