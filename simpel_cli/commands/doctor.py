"""`simpel doctor`: whether this installation computes right."""


def doctor() -> None:
    """Show what this installation consists of, and test in a few seconds whether it computes correctly.

    Examples:
      simpel doctor

      simpel doctor > installation.txt
    """
    from simpel_cli.reporting.doctor import doctor as task

    task()
