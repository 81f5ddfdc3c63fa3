"""The depth block."""

# SPDX-License-Identifier: Apache-2.0
from pkgutil import extend_path

# The compiled `_native` lies in site-packages while the Python code may come from a checkout.
__path__ = extend_path(__path__, __name__)
