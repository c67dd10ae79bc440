"""The estimators: they turn the harmonics or samples of one recording into a judged fit or driver.

`etid.identify` reads files and handles batches.
"""
