"""The methods: harmonics or samples of one recording in, a judged fit or driver out.

Reading files, and batches, belong to `etid.identify`.
"""
