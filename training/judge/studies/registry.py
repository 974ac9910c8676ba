# SPDX-License-Identifier: Apache-2.0
"""All studies that train, by name."""

from __future__ import annotations

from training.judge.studies import auto_decoder, latent, sweeps
from training.judge.studies.study import Study

STUDIES: dict[str, Study] = {study.name: study for study in (*sweeps.STUDIES, auto_decoder.STUDY, latent.STUDY)}
"""Name -> study."""
