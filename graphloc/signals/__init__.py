# SPDX-License-Identifier: Apache-2.0
"""What a stream tells of itself, before anything is solved: frozen, spiked, jumping, paused, too dense, how noisy."""
