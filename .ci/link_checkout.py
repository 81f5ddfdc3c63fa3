"""Lets Python code of this checkout win over the installed copy; what is compiled stays installed."""

# SPDX-License-Identifier: Apache-2.0
import sysconfig
from pathlib import Path

site_packages = sysconfig.get_path("purelib")
checkout = str(Path(__file__).resolve().parents[1])
# Just before site-packages, so that the standard library and PYTHONPATH keep their precedence.
line = f"import sys; sys.path.insert(sys.path.index({site_packages!r}), {checkout!r})\n"
Path(site_packages, "scenefactory_dev.pth").write_text(line, encoding="utf-8")
