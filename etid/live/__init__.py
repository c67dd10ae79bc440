"""The live view: a page on this computer that shows a running display, and can stop it."""
