# SPDX-License-Identifier: Apache-2.0
"""AprilTags: from images, or from detections that a bag already holds, to sightings of surveyed tags."""
