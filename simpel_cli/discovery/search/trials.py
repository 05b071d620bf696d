"""Fits of sets of effects: one term more, one less, another in its place.

Every known parameter is refitted with every set: held at their old values, they would leave remainders that look like
effects.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from simpel_cli.discovery.search.budget import Budget
from simpel_cli.discovery.search.by_group.spreads import BEGIN, Spreading, other_slots, respread, slots_of
from simpel_cli.discovery.search.score_test import Score, promises
from simpel_cli.errors import DataError
from simpel_cli.filtering.likelihood.fit import Fitter, Hypothesis, Optimum
from simpel_cli.filtering.race import Race
from simpel_cli.filtering.setup import Key, Setup
from simpel_cli.filtering.two_optima import other_optima
from simulators.groups import spreads_of

ACCEPT = 4.5  # nats of evidence that an effect must earn
FURTHER = 2.3  # nats more for every effect that is there already: each makes another one ten times less probable
TIE = 3.0  # nats within which two names are not distinguished
SAME = 1.0  # nats of log posterior within which only the widths of two priors differ, not what the data say
PROMISING = 1.5  # nats that the score must promise for a candidate to be fitted
SHARE = 0.3  # of the largest promise, likewise
ALIKE = 0.8  # of what the term promises whose place a rival would take
SHARE_OF_OWN = 0.4  # likewise
NEARLY_THE_BEST = 0.7  # of the gain of a stage's best, which others have to reach where no search begins with them
KEPT = 4  # starts of a stage that are fitted in any case
ASTRAY = 1.0  # nats of log posterior by which a larger model's fit is worse than the smaller model's
NEARLY, MUCH_NEARER = 0.01, 1e-4  # of a parameter's range
QUIETER = 0.1  # of the range of log q, than at the very start
ANYWHERE = 3  # starts of an effect anywhere in the ranges of its parameters
STARTS = 6  # of the model as it is
SPREADS = (0.03, 0.1, 0.35, 1.0)  # of groups, of their largest

Answer = TypeVar("Answer")


def asked(effects: int) -> float:
    """Return the nats of evidence that each of so many effects must earn."""
    return ACCEPT + FURTHER * (effects - 1)


class Trial(NamedTuple):
    """One set of effects and where its fit came to rest."""

    terms: tuple[int, ...]
    optimum: Optimum


class Stage(NamedTuple):
    """One step of the forward selection: fits of the candidates that were not left behind, best first."""

    before: Trial
    trials: tuple[Trial, ...]  # each is `before` and one term more
    screened: tuple[tuple[int, float], ...] = ()  # terms that were not fitted: standard deviation of the amplitude


class Search:
    """The search over sets of effects of one setup.

    Args:
        plan: what it works with.
        fitter: of its program.
        report: takes a line.
        alike: spreads of parameters of the simulator whose groups have one value until a hypothesis frees them; `plan.start`
            has none for them.
    """

    def __init__(
        self,
        plan: Setup,
        fitter: Fitter | Spreading,
        report: Callable[[str], None] = lambda _: None,
        alike: Sequence[int] = (),
    ) -> None:
        self.plan, self.report = plan, report
        self.terms = plan.augmented.terms
        n_p, n_r, n_q = plan.coordinates.sizes
        params = plan.augmented.model.params
        every = spreads_of(params)
        self.own = {row: rows for row, rows in every.items() if row not in alike}
        last = {rows[-1] + 1 for rows in every.values()}  # of what was never seen the data tell nothing
        # unknowns that begin, and stay, as in `plan.start`
        self.still = (*last, *(i for row in alike for i in (row, *every[row])))
        self.always = tuple(i for i in range(len(params)) if i not in every and i not in self.still)
        self.noise = tuple(range(n_p, n_p + n_r + n_q))
        self.always += self.noise
        self.rows = [tuple(plan.augmented.rows(t)) for t in self.terms]
        differing = [plan.augmented.spreads(t) for t in self.terms]
        self.members = [tuple(i for own in each.values() for i in own[:-1]) for each in differing]
        self.spreads = every | {row: own[:-1] for each in differing for row, own in each.items()}
        self.slot_of, self.other_slots = slots_of(plan, every), other_slots(plan)
        self.spreads_of = [tuple(each) for each in differing]
        inner = fitter.fitter if isinstance(fitter, Spreading) else fitter
        self.fitter = Spreading(inner, self.spreads) if self.spreads else inner
        self.ones = np.ones(len(plan.windows.episode))
        self.tried = 0
        self.budget = Budget()
        self.declared: dict[str, tuple[float, float]] = {}  # ranges of parameters that are wider here than was declared
        self.banned: set[int] = set()  # terms that are no candidates
        self.together: set[frozenset[Key]] = set()  # pairs of terms for which no single one stands
        self.known: dict[frozenset[int], Optimum] = {}  # the best fit of every set of terms so far
        self._answers: dict[tuple[Any, ...], Any] = {}  # to what was asked already

    def once(self, question: tuple[Any, ...], work: Callable[[], Answer]) -> Answer:
        """Return what work comes to, which is not done again for the same question."""
        if question not in self._answers:
            self._answers[question] = work()
        answer: Answer = self._answers[question]
        return answer

    def forget(self) -> None:
        """Forget every fit and every answer."""
        self.known.clear()
        self._answers.clear()

    def free(self, terms: Sequence[int]) -> tuple[int, ...]:
        """Unknowns that move when these terms are there."""
        return self.always + tuple(row for t in terms for row in (*self.rows[t], *self.members[t]))

    def all_rows(self, term: int) -> list[int]:
        """Return every unknown of a term, with those of its groups."""
        return [*self.rows[term], *self.spreads_of[term], *self.members[term]]

    def fits(self, terms: Sequence[int]) -> bool:
        """Whether the compiled program has room for them."""
        return len(self.free(terms)) <= self.fitter.width

    def promises(
        self, before: Trial, starts: Sequence[tuple[int, Hypothesis]], sets: Sequence[tuple[int, ...]] | None = None
    ) -> list[Score]:
        """Return what each start of each term, or each set of starts together, promises beside a fitted set of terms."""
        free, z = self.free(before.terms), before.optimum.z
        return promises(self.plan, self.fitter, self.fitter.width, free, z, starts, sets)

    def promised(self, before: Trial, candidates: Sequence[int]) -> list[tuple[int, Hypothesis, Score]]:
        """Return every start of every candidate with what it promises, which is not worked out again."""

        def work() -> list[tuple[int, Hypothesis, Score]]:
            starts = self.starts(before, candidates)
            return [(*s, score) for s, score in zip(starts, self.promises(before, starts), strict=True)]

        return self.once(("promised", before.terms, before.optimum.z.tobytes(), tuple(candidates)), work)

    def hypotheses(self, terms: tuple[int, ...], new: int, z: np.ndarray) -> list[Hypothesis]:
        """Starts of a set of terms of which one is new and begins at each of its start points."""
        parameters = self.terms[new].parameters
        hypotheses = []
        for s in range(max((len(k.starts) for k in parameters), default=1)):
            start = self.loud(z)
            for row, parameter in zip(self.rows[new], parameters, strict=True):
                start[row] = self.plan.coordinates.unit(row, parameter.starts[min(s, len(parameter.starts) - 1)])
            start[list(self.spreads_of[new])] = BEGIN
            hypotheses.append(Hypothesis(start, self.free(terms), self.ones))
        return hypotheses

    def beside(self, before: Trial, new: int) -> list[Hypothesis]:
        """Starts of a model with one term more at the optimum without it, the term all but switched off.

        With loud noise, and with that of the optimum, where a step of the term has to be much smaller.
        """
        z, starts = before.optimum.z, []
        for noise, step in ((self.loud(z), NEARLY), (z, MUCH_NEARER)):
            start = noise.copy()
            for row in self.rows[new]:
                start[row] = np.clip(self.plan.start[row], step, 1 - step)
            start[list(self.spreads_of[new])] = BEGIN
            starts.append(Hypothesis(start, self.free((*before.terms, new)), self.ones))
        return starts

    def loud(self, z: np.ndarray) -> np.ndarray:
        """Return a start with noise that a step in the wrong direction can hide in.

        With little process noise a size that is off costs thousands of nats, and a fit creeps. And a wrong model follows
        a sensor as if that had no noise: a better one has to find it again.
        """
        z = z.copy()
        n_p, n_r, n_q = self.plan.coordinates.sizes
        q, r = np.arange(n_p + n_r, n_p + n_r + n_q), np.arange(n_p, n_p + n_r)
        z[q] = np.maximum(z[q], self.plan.start[q] - QUIETER)
        z[r] = np.where(z[r] < NEARLY, self.plan.start[r], z[r])
        return z

    def off(self, z: np.ndarray, terms: Sequence[int]) -> np.ndarray:
        """Switch terms off."""
        z = z.copy()
        for t in terms:
            rows = self.all_rows(t)
            z[rows] = self.plan.start[rows]
        return z

    def base(self) -> Trial:
        """Calibrate the simulator as it is, from several starts, or from where it came to already."""
        random = np.random.default_rng(0)
        starts = [self.plan.start] if self.plan.optimum is None else [self.plan.optimum, self.plan.start]
        n = len(self.plan.augmented.model.params)
        for _ in range(STARTS - 1 if self.plan.optimum is None else 0):
            z = self.plan.start.copy()
            z[:n] = random.uniform(0.1, 0.9, n)
            z[list(self.still)] = self.plan.start[list(self.still)]
            starts.append(z)
        found = self.fitter([Hypothesis(z, self.free(()), self.ones) for z in starts])
        if not any(np.isfinite(o.log_evidence) for o in found):
            raise DataError(
                f"sim: no parameters within the ranges of {self.plan.augmented.model.name} gave the measurements a finite "
                f"likelihood, in {len(starts)} tries: its states run away or its rates are not finite. Simulate it from a "
                "measured start (`simpel simulate`), narrow sim.parameters, or guard roots, logarithms and divisions "
                "with max(., 1e-9)."
            )
        best = self.best((), found)
        best = self.best((), other_optima(self.plan, self.fitter, [best.optimum], -np.inf))
        return self._with_spreads(best) if self.own and self.plan.optimum is None else best

    def _with_spreads(self, base: Trial) -> Trial:
        """Begin with several spreads of groups, the same share of their ranges, of which each goes on by itself."""
        z, free = base.optimum.z, self.free(())
        starts = [respread(self.plan.coordinates, z, dict.fromkeys(self.own, level), self.own) for level in SPREADS]
        return self.best((), self.fitter([Hypothesis(start, free, self.ones) for start in starts]))

    def best(self, terms: tuple[int, ...], found: Sequence[Optimum]) -> Trial:
        """Return the best of some fits of one set of terms, or an earlier one that was better."""
        name = frozenset(terms)
        known = [self.known[name]] if name in self.known else []
        self.known[name] = max([*found, *known], key=lambda o: o.log_evidence)
        return Trial(terms, self.known[name])

    def starts(self, before: Trial, candidates: Sequence[int]) -> list[tuple[int, Hypothesis]]:
        """Return every start of every candidate."""
        return [
            (t, hypothesis)
            for t in candidates
            for hypothesis in self.hypotheses((*before.terms, t), t, before.optimum.z)
        ]

    def anywhere(self, before: Trial, candidates: Sequence[int]) -> list[tuple[int, Hypothesis]]:
        """Return starts of the candidates that have a shape, anywhere in the ranges of what they are made of.

        What has but a size promises beside the model without it what it is worth. An edge, a level or a share may promise
        nothing from where it begins, and be most of what is missing.
        """
        random = np.random.default_rng(0)
        starts = []
        for t in candidates:
            for _ in range(ANYWHERE if len(self.rows[t]) > 1 and not self.terms[t].depends_on else 0):
                z = self.loud(before.optimum.z)
                z[list(self.rows[t])] = random.uniform(NEARLY, 1 - NEARLY, len(self.rows[t]))
                z[list(self.spreads_of[t])] = BEGIN
                starts.append((t, Hypothesis(z, self.free((*before.terms, t)), self.ones)))
        return starts

    def add(self, before: Trial, candidates: Sequence[int], least: float = PROMISING, *, widely: bool = False) -> Stage:
        """Fit `before` with one of the candidates more, each from its promising starts; best first.

        Args:
            before: the model without it.
            candidates: terms.
            least: nats that a start must promise to be fitted.
            widely: fit them from `anywhere`, too, whatever that promises.
        """
        more = self.anywhere(before, candidates) if widely else ()
        question = "added", before.terms, before.optimum.z.tobytes(), tuple(candidates), least, widely
        return self.once(question, lambda: self._added(before, candidates, least, more))

    def _added(
        self, before: Trial, candidates: Sequence[int], least: float, more: Sequence[tuple[int, Hypothesis]]
    ) -> Stage:
        self.tried += len(candidates)
        each = self.promised(before, candidates)
        starts, scores = [(t, hypothesis) for t, hypothesis, _ in each], [score for *_, score in each]
        promised, sure = np.array([(score.gain, score.sure) for score in scores]).reshape(-1, 2).T
        order = sorted(range(len(starts)), key=lambda i: -promised[i])
        named = np.array([not self.terms[t].depends_on for t, _ in starts], bool)
        finite = np.where(np.isfinite(sure), sure, 0.0)
        # functions without a name promise much where much is left: they keep no name from being fitted
        most = np.where(named, finite[named].max(initial=0.0), finite.max(initial=0.0))
        going = [i for rank, i in enumerate(order) if rank < KEPT or promised[i] > max(least, SHARE * most[i])]
        begun = [*(starts[i] for i in going), *more]
        fits, behind = dict[int, list[Optimum]](), dict[int, list[float]]()
        named = np.array([not self.terms[t].depends_on for t, _ in begun], bool)
        race = Race(before.optimum.loss, NEARLY_THE_BEST if before.terms else SHARE, named)
        for (t, _), optimum in zip(begun, self.fitter([h for _, h in begun], hopes=race), strict=True):
            if optimum.left:
                behind.setdefault(t, []).append(optimum.loss)
            else:
                fits.setdefault(t, []).append(optimum)
        # every start of a term may have been left in a valley that is worse than the model without it
        best = max((before.optimum.loss - o.loss for own in fits.values() for o in own), default=0.0)
        lost = {t for (t, _), s in zip(starts, sure, strict=True) if s > max(least, race.share * best)} - fits.keys()
        worst = before.optimum.loss + ASTRAY
        fits |= {t: [] for t, own in behind.items() if t in lost and min(own) > worst}
        # a model that contains another cannot be worse: such a fit went astray, and begins again beside the smaller model
        astray = [t for t, optima in fits.items() if min((o.loss for o in optima), default=np.inf) > worst]
        again = [(t, start) for t in astray for start in self.beside(before, t)]
        for (t, _), optimum in zip(again, self.fitter([start for _, start in again]), strict=True):
            fits[t].append(optimum)
        trials = [self.best((*before.terms, t), optima) for t, optima in fits.items()]
        left = {
            t: min(s.sd for s, (u, _) in zip(scores, starts, strict=True) if u == t) for t, _ in starts if t not in fits
        }
        trials.sort(key=lambda t: -t.optimum.log_evidence)
        other = other_optima(self.plan, self.fitter, [t.optimum for t in trials], before.optimum.log_evidence)
        trials = [self.best(t.terms, [optimum]) for t, optimum in zip(trials, other, strict=True)]
        ordered = sorted(trials, key=lambda t: -t.optimum.log_evidence)
        return Stage(before, tuple(ordered), tuple((t, sd) for t, sd in left.items() if np.isfinite(sd)))

    def best_named(self, trials: Sequence[Trial], least: float = -np.inf) -> Trial | None:
        """Best trial with a named new effect; a more general name must earn its generality over a simpler one.

        Args:
            trials: best first.
            least: evidence that the simpler one must reach.
        """
        named = [t for t in trials if not self.terms[t.terms[-1]].depends_on]
        if not named:
            return None
        best = named[0]
        own = self.terms[best.terms[-1]]
        for other in named[1:]:
            term = self.terms[other.terms[-1]]
            place, *_ = own.acts_on.split(", ")  # what a general one takes from, where another state gains it
            simpler = term.effect in own.generalises and place in (term.acts_on, *term.acts_on.split(", "))
            value = other.optimum.log_evidence
            if simpler and value > least and best.optimum.log_evidence - value < ACCEPT:
                best, own = other, term
        return best

    def candidates(self, terms: Sequence[int]) -> list[int]:
        """Terms that can still be added."""
        taken = self.banned.union(terms)
        return [t for t in range(len(self.terms)) if t not in taken and self.fits((*terms, t))]

    def less(self, current: Trial, rest: tuple[int, ...]) -> list[Hypothesis]:
        """Starts of a set of terms that has fewer than the current one."""
        z = self.off(current.optimum.z, tuple(t for t in current.terms if t not in rest))
        n_p, n_r, n_q = self.plan.coordinates.sizes
        loud = z.copy()  # the noise that the terms explained has to go somewhere
        loud[n_p + n_r : n_p + n_r + n_q] = self.plan.start[n_p + n_r : n_p + n_r + n_q]
        return [Hypothesis(z, self.free(rest), self.ones), Hypothesis(loud, self.free(rest), self.ones)]

    def part(self, current: Trial, rest: tuple[int, ...]) -> Trial:
        """Return the best fit of some of a model's terms, which is made if there is none yet."""
        return self.best(rest, () if frozenset(rest) in self.known else self.fitter(self.less(current, rest)))

    def prune(self, current: Trial) -> tuple[Trial, tuple[float, ...], list[Trial]]:
        """Drop what no longer earns its place; return the rest, what each term adds to it, and the rest without it."""
        while current.terms:
            without = self.without(current)
            gains = [current.optimum.log_evidence - t.optimum.log_evidence for t in without]
            weakest = int(np.argmin(gains))
            if gains[weakest] >= asked(max(1, sum(not self.terms[t].depends_on for t in current.terms))):
                return current, tuple(gains), without
            current = without[weakest]
        return current, (), []

    def without(self, current: Trial) -> list[Trial]:
        """Fit every set that lacks one of the terms."""
        sets = [tuple(t for t in current.terms if t != gone) for gone in current.terms]
        hypotheses = [hypothesis for rest in sets for hypothesis in self.less(current, rest)]
        found = self.fitter(hypotheses)
        return [self.best(rest, found[2 * i : 2 * i + 2]) for i, rest in enumerate(sets)]

    def rivals(self, chosen: Trial, rest: Trial) -> tuple[Trial, ...]:
        """Return the trials in which another name takes the place of the term that `rest` lacks, and does as well."""
        (own,) = set(chosen.terms) - set(rest.terms)
        candidates = [t for t in self.candidates(rest.terms) if t != own]
        starts = self.starts(rest, [own, *candidates])
        promised = [
            (t, score.gain)
            for (t, _), score in zip(starts, self.promises(rest, starts), strict=True)
            if score.switched_off
        ]
        earned = chosen.optimum.log_evidence - rest.optimum.log_evidence
        most = max((gain for t, gain in promised if t == own), default=earned)
        # what promises as much may be the same to the data: it begins where the chosen model ended, too
        alike = list(dict.fromkeys(t for t, gain in promised if t != own and gain > ALIKE * most))
        z = self.off(chosen.optimum.z, (own,))
        starts = [(t, hypothesis) for t in alike for hypothesis in self.hypotheses((*rest.terms, t), t, z)]
        for (t, _), optimum in zip(starts, self.fitter([hypothesis for _, hypothesis in starts]), strict=True):
            self.best((*rest.terms, t), [optimum])
        trials = self.add(rest, candidates, max(PROMISING, SHARE_OF_OWN * most)).trials
        fitted = {t.terms[-1] for t in trials}
        trials += tuple(self.best((*rest.terms, t), ()) for t in alike if t not in fitted)
        return tuple(t for t in trials if self.as_good(t, chosen, own))

    def as_good(self, trial: Trial, chosen: Trial, own: int) -> bool:
        """Whether a trial does as well as the chosen model whose term `own` its last one replaces."""
        term, here, there = self.terms[trial.terms[-1]], trial.optimum, chosen.optimum
        place, *_ = term.acts_on.split(", ")
        if term.depends_on:
            return here.log_evidence >= there.log_evidence + ACCEPT
        if self.terms[own].effect in term.generalises and self.terms[own].acts_on in (term.acts_on, place):
            return False
        fits = len(term.parameters) <= len(self.terms[own].parameters) and here.loss <= there.loss + SAME
        return fits or here.log_evidence >= there.log_evidence - TIE
