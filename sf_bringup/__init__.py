"""Plans, starts, replays, records and evaluates production lines; the sf command."""

# SPDX-License-Identifier: Apache-2.0
