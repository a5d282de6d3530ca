# SPDX-License-Identifier: Apache-2.0
"""What a sensor's data show before anything is solved: freezing, spikes, jumps, pauses, rate and noise."""
