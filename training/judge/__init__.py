# SPDX-License-Identifier: Apache-2.0
"""Judge models and reconstructions against 3D truth: evaluation, benchmark, studies, pictures."""
