# SPDX-License-Identifier: Apache-2.0
"""The schedule of a run: phase and learning rate of every step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from training.recipe import Recipe

REGRESSION, UNSUPERVISED, HELD = "regression", "unsupervised", "held"
"""Phases: learn the lesson's shapes; minimise both levels; minimise the upper level over held solutions."""

_WARM_UP_STEPS = 200


@dataclass(frozen=True)
class Schedule:
    """Phases and rates as functions of the number of steps done.

    A run has one or more generations of networks. Each first learns a lesson by regression, then minimises the
    objective.
    """

    recipe: Recipe

    @property
    def regression_steps(self) -> int:
        """Steps of regression to the start."""
        return self.recipe.regression_steps if self.recipe.start != "random" else 0

    @property
    def generation_steps(self) -> int:
        """Steps of one generation."""
        return self.regression_steps + self.recipe.steps

    @property
    def steps(self) -> int:
        """Steps of all generations."""
        return self.recipe.generations * self.generation_steps

    def step_in_generation(self, step: int) -> int:
        """Return the steps that the current generation has done."""
        return step % self.generation_steps

    def lesson_steps(self, step: int) -> int:
        """Return the steps of regression of the current generation.

        Later generations begin with better shapes than they give for long; solutions renewed too early would lose them.
        """
        return self.regression_steps if step < self.generation_steps else self.generation_steps // 2

    def phase(self, step: int) -> str:
        """Return the phase of the step that follows ``step`` steps."""
        if self.step_in_generation(step) < self.lesson_steps(step):
            return REGRESSION
        return HELD if self.recipe.hold else UNSUPERVISED

    def begins_generation(self, step: int) -> bool:
        """Return whether the next step is the first of a generation other than the first one."""
        return step > 0 and self.step_in_generation(step) == 0 and self.phase(step) == REGRESSION

    def renews_solutions(self, step: int) -> bool:
        """Return whether solutions are solved anew before the next step: in a new generation, or when a hold ends."""
        if self.phase(step) != HELD:
            return self.begins_generation(step)
        return (self.step_in_generation(step) - self.lesson_steps(step)) % self.recipe.hold == 0

    def ends_part(self, step: int) -> bool:
        """Return whether a lesson, a generation or the run ends with step number ``step``."""
        return self.step_in_generation(step) in (0, self.lesson_steps(step)) or step >= self.steps

    def rate_factor(self, step: int) -> float:
        """Return the factor of all learning rates: a warm-up, then a cosine to zero in each phase.

        With held solutions both phases share one cosine, as they do the same work. Its first half stays at the full
        rate, because a solution that is renewed late has to be learned anew.
        """
        if self.recipe.hold:
            own_step = self.step_in_generation(step)
            done = max(0.0, 2 * own_step / self.generation_steps - 1)
        else:
            first = self.step_in_generation(step) < self.regression_steps
            own_step = self.step_in_generation(step) - (0 if first else self.regression_steps)
            done = own_step / (self.regression_steps if first else self.recipe.steps)
        warm_up = min(1.0, (own_step + 1) / _WARM_UP_STEPS)
        return float(warm_up * 0.5 * (1 + np.cos(np.pi * done)))
