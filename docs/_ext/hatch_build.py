"""Metadata that depends on the address of the repository, which ``pyproject.toml`` holds once."""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class AddressHook(MetadataHookInterface):
    """Adds the project's links, and makes the README's links absolute, as a package index needs them."""

    def update(self, metadata: dict[str, Any]) -> None:
        address = self.config["address"].rstrip("/")
        readme = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["urls"] = dict(self.config["related"])
        if address:
            metadata["urls"] |= {
                "Code": address,
                "Documentation": f"{address}/tree/HEAD/docs",
                "Changelog": f"{address}/blob/HEAD/CHANGELOG.md",
                "Issues": f"{address}/issues",
            }
            readme = re.sub(r"\]\((?!https?:|#)([^)]+\.png)\)", rf"]({address}/raw/HEAD/\1)", readme)
            readme = re.sub(r"\]\((?!https?:|#)([^)]+)\)", rf"]({address}/blob/HEAD/\1)", readme)
        metadata["readme"] = {"content-type": "text/markdown", "text": readme}
