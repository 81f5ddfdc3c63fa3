"""The vocabulary and the wire: what two or more blocks share. Importable without ROS outside ``ros/``."""

# SPDX-License-Identifier: Apache-2.0
from pkgutil import extend_path

# In a source checkout the generated msg/ and srv/ modules live in site-packages, beside this folder's Python code.
__path__ = extend_path(__path__, __name__)
