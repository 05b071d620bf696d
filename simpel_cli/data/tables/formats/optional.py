"""Libraries that only some kinds of files need: they come with an extra of the package."""

import importlib
from typing import Any

from simpel_cli.errors import DataError


def library(name: str, extra: str, file: str) -> Any:
    """Import a library.

    Args:
        name: of the module.
        extra: of the package, which brings it.
        file: which needs it.

    Raises:
        DataError: it is not installed; the message names the extra.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise DataError(
            f"{file}: to read it, `{name.partition('.')[0]}` is needed, which is not installed: pip install 'simpel[{extra}]'."
        ) from error
