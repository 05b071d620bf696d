"""`simpel doctor`: whether this installation computes right."""


def doctor() -> None:
    """Tell what this installation has, and test in a few seconds whether it computes right."""
    from simpel_cli.reporting.doctor import doctor as task

    task()
