"""A yardstick for engines: some seventy problems, what was proved of them once, and a comparison with what is now.

    python -m tests.yardstick [NAME ...] [--limit 20] [--method M] [--out FILE] [--against tests/yardstick/stored.json]

``problems.toml`` holds the problems, ``stored.json`` the run that is compared with. Every problem has a process of its
own. It is asked for a verdict at ``ask`` times its probability of failing, and for a certificate of that; where the
bounds are not near each other then, for both of them at that probability itself, where no engine may end early. All
seconds, those of limits too, are of processor time (`measure`).
"""
