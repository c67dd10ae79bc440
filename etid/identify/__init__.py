"""What a user calls: identify one recording, many, a file, or all of them jointly.

The methods themselves are in `etid.estimators`.
"""
