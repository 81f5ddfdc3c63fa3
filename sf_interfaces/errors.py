"""The one exception family of SceneFactory.

Every error a user can cause is a :class:`SceneFactoryError` whose message is one sentence that says
what is wrong, where, and how to mend it. The command line prints it and exits with code 2; any other
exception is a bug and exits with code 1.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations


class SceneFactoryError(Exception):
    """Base of all errors that bad input or bad configuration can cause."""


class ConfigError(SceneFactoryError):
    """An unknown key, a value out of range, or a combination that makes no sense."""


class CalibrationError(SceneFactoryError):
    """Intrinsics or an extrinsic are missing or malformed."""


class FormatError(SceneFactoryError):
    """A file, message or data set does not have the layout it should have."""


class PlanError(SceneFactoryError):
    """No production line leads from the given quantities to the goal."""


class TrackingLost(SceneFactoryError):
    """The tracker cannot relate the current frame to the map."""


class InsufficientParallax(SceneFactoryError):
    """The views do not constrain depth: their baseline is too small."""
