# SPDX-License-Identifier: Apache-2.0
"""What both solvers ask of an estimate: which measurements are right, how noisy sensors and IMU are, how far a pose can be trusted."""
