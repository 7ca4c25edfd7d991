"""Which parameters do logs determine, how well, and what do they leave open?

`fit` is the posterior, `intervals` what its errors make of it, `diagnose` the words,
`forecasts` what it predicts; `misfit`, `missing_physics`, `identifiability` and
`exact_posterior` each ask one question more.
"""
