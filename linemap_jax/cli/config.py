"""`linemap config`: all settings as a file to edit."""

import dataclasses
from pathlib import Path
from typing import Literal

from linemap_jax.cli.options import ScannerName, noise_of_scanner, options_of_method


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Print all settings as TOML, each with its meaning: a file for --config of the other commands."""

    preset: Literal["default", "paper"] = "default"
    """The method."""
    config: Path | None = None
    """Settings file that goes over the preset."""
    scanner: ScannerName | None = None
    """The instrument: stands for the noise that its data sheet states, unless the settings file states it."""

    def run(self) -> int:
        """Print them, and give the exit status."""
        options = options_of_method(self.preset, self.config, noise_of_scanner(self.scanner))
        from linemap_jax.io.config import SECTIONS, config_text

        print(config_text({section: options[section] for section in SECTIONS}), end="")
        return 0
