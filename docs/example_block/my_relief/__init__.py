"""An example block: an image from depth by shading its relief."""

# SPDX-License-Identifier: Apache-2.0
