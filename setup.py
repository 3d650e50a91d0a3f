"""What pyproject.toml cannot say: the README as it is where its folder is not."""

import re
from pathlib import Path


def without_its_folder(text: str) -> str:
    """Drop pictures and what is said below them, and links that are no addresses.

    An index of packages has no such files.
    """
    text = re.sub(r"!\[[^]]*\]\((?!https?:)[^)]*\)\n+(\*[^*]+\*\n+)?", "", text)
    return re.sub(r"\[([^]]+)\]\((?!https?:)[^)]*\)", r"\1", text)


if __name__ == "__main__":
    from setuptools import setup

    setup(
        long_description=without_its_folder(Path("README.md").read_text(encoding="utf-8")),
        long_description_content_type="text/markdown",
    )
