# SPDX-License-Identifier: Apache-2.0
"""AprilTags: from images, or from detections in the bag, to sightings of surveyed tags."""
