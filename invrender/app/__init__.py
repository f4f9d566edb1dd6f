"""``invrender app``: a local web page that leads a person through a capture.

`server` answers the browser, `guard` decides whom, `store` keeps the captures as plain folders,
`workers` run the work of `work` in processes that may be killed at any time.
"""
