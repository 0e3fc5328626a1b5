"""From a selection to Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgwarp.apps.editing.selection import Selection, Term, parse_term
from sgwarp.encoders.base import TextEncoder
from sgwarp.errors import InputError
from sgwarp.ops.splatting.contributors import top_contributors
from sgwarp.querying.scores import class_votes
from sgwarp.querying.scoring import score_texts
from sgwarp.scene import Camera, Gaussians, InstanceMap, Semantics, View

NEIGHBORS = 8  # of a Gaussian when pieces are told apart
LINK = 4.0  # neighbors farther apart than this many median distances belong to different pieces
LEAST_PIECE = 0.1  # share of the largest piece that another one must have to stay
GUESSED = ("text", "id", "box", "click")  # terms that may take in scattered pieces; others name each Gaussian
HALF = 0.5  # of the threshold: what scores more belongs to a selection that it is connected with
SAME = 0.8  # share of the best instance's score that another instance must have to be named by the same text
CLICK_DEPTH = 8  # Gaussians of a pixel that a click asks
LOOKS_ALIKE = 0.9  # cosine to what was clicked at


@dataclass(frozen=True, eq=False)
class EditContext:
    """What selections may need, all of it belonging to the scene as it was loaded.

    Attributes:
        semantics: Lifted features, for texts.
        encoder: Text encoder of their space; None for lifted labels.
        instances: For id:N, whole instances by text, and clicks.
        views: For clicks.
    """

    semantics: Semantics | None = None
    encoder: TextEncoder | None = None
    instances: InstanceMap | None = None
    views: Sequence[View] = field(default_factory=tuple)

    def require_scene(self, gaussians: Gaussians) -> None:
        """Raise InputError if something belongs to another scene."""
        for part in (self.semantics, self.instances):
            if part is not None:
                part.require_scene(gaussians)


@dataclass(frozen=True, eq=False)
class EditState:
    """A scene after some steps.

    Attributes:
        gaussians: As it is now.
        rows: Row of the scene as loaded that each Gaussian comes from, int64 [N].
        copies: Which duplication made it, 0 for none, int32 [N].
        selected: What the step before was applied to, or the copy it made, bool [N].
    """

    gaussians: Gaussians
    rows: Tensor
    copies: Tensor
    selected: Tensor


def pick(state: EditState, selection: Selection, context: EditContext) -> Tensor:
    """The selected Gaussians, bool [N].

    Raises:
        InputError: A term needs what the context lacks, names an unknown id, copy or view, or nothing is selected.
    """
    chosen = torch.zeros(len(state.gaussians), dtype=torch.bool, device=state.gaussians.device)
    kept = torch.zeros_like(chosen)
    as_it_is = replace(selection, clean=False)
    for term in selection.keep:
        kept |= _pick_clean(state, parse_term(term), as_it_is, context, ~kept)
    for term in selection.select:
        chosen |= _pick_clean(state, parse_term(term), selection, context, ~kept)
    if selection.grow and bool(chosen.any()):
        chosen = grow(state.gaussians.means, chosen, selection.grow) & ~kept
    if not bool(chosen.any()):
        raise InputError(f"select {', '.join(selection.select)}: selects no Gaussian; {_advice(selection)}")
    return chosen


def _advice(selection: Selection) -> str:
    if any(parse_term(term).kind == "text" for term in selection.select):
        return "lower --threshold, or say it in other words"
    return "choose another term, or keep and shrink less"


def _pick_clean(state: EditState, term: Term, selection: Selection, context: EditContext, free: Tensor) -> Tensor:
    """What a term selects among some Gaussians, without its scattered pieces, bool [N]."""
    means, around = state.gaussians.means, None
    if term.kind in ("text", "id"):
        by = score_text(term.text, selection, context) if term.kind == "text" else _pick_id(term, context)
        chosen, around = (part.to(state.rows.device)[state.rows] for part in by)
    else:
        chosen = _pick_term(state, term, context)
    chosen = chosen & free
    if selection.clean and term.kind in GUESSED and bool(chosen.any()):
        chosen = largest_pieces(means, chosen)
    return chosen if around is None else spread(means, chosen, around & free)


def _pick_term(state: EditState, term: Term, context: EditContext) -> Tensor:
    """What a term selects that is neither a text nor an id, bool [N]."""
    gaussians = state.gaussians
    if term.kind == "all":
        return torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.device)
    if term.kind == "last":
        return state.selected
    if term.kind == "copy":
        number = int(term.numbers[0])
        if number > int(state.copies.max()):
            raise InputError(f"select copy:{number}: there are {int(state.copies.max())} copies so far")
        return state.copies == number
    if term.kind == "box":
        corners = torch.tensor(term.numbers, dtype=torch.float64, device=gaussians.device)
        means = gaussians.means.double()
        return ((means >= corners[:3]) & (means <= corners[3:])).all(dim=1)
    if term.kind == "rows":
        return _pick_rows(state, term)
    return _pick_click(state, term, context)


def _pick_id(term: Term, context: EditContext) -> tuple[Tensor, Tensor]:
    """Members of an instance, and what leans towards it, bool [N] of the scene as loaded."""
    if context.instances is None:
        raise InputError(f"select id:{term.numbers[0]:g}: needs --instances, what `sgwarp instances` wrote")
    number = int(term.numbers[0])
    return context.instances.members(number), context.instances.leaning(number)


def score_text(text: str, selection: Selection, context: EditContext) -> tuple[Tensor, Tensor]:
    """Gaussians of the scene as loaded that a text names.

    Where instances are known a text names whole ones: that with the best mean score, and those that come close to it.

    Returns:
        chosen: Those that score more than the threshold, bool [N].
        around: Those that belong to it where they are connected with it, bool [N]: they score more than half the
            threshold, or are undecided and lean towards the instance.
    """
    semantics = context.semantics
    if semantics is None:
        named = _named(text, context.instances)
        if named is not None:
            return named
        raise InputError(f"select '{text}': needs --semantics, what `sgwarp lift` wrote for this scene")
    asked = [text, *selection.negatives]
    if semantics.labels is not None:
        scores, least = class_votes(semantics, asked), selection.threshold
        high = low = scores[:, 0] > least
    else:
        if context.encoder is None:
            raise InputError(f"select '{text}': needs the text encoder of space '{semantics.space}'")
        answers = score_texts(semantics, asked, context.encoder)
        if not bool(answers.known[0]):
            raise InputError(f"select '{text}': the encoder knows nothing like it; choose another word")
        assert answers.evidence is not None
        scores, least = answers.evidence, 0.0
        if context.instances is None:
            _require_evidence(text, float(scores[:, 0].max()), answers.level)
        stands_out = scores[:, 0] > answers.level
        high = stands_out & (answers.values[:, 0] > selection.threshold)
        low = stands_out & (answers.values[:, 0] > HALF * selection.threshold)
    rivals = scores[:, 1:].max(dim=1).values if selection.negatives else torch.full_like(scores[:, 0], -torch.inf)
    if context.instances is not None:
        return _name_instances(scores[:, 0], rivals, semantics.seen, context.instances, least)
    fits = scores[:, 0] > rivals
    return high & fits, low & fits


def _require_evidence(text: str, best: float, level: float) -> None:
    """Raise InputError if nothing shows what a text names: rescaled scores have a best place all the same."""
    if best <= level:
        found = f"nothing stands out as that (evidence {best:.2f}, and this encoder needs more than {level:.2f})"
        raise InputError(f"select '{text}': {found}; select it by click:, id: or box:, or give --instances")


def _named(text: str, instances: InstanceMap | None) -> tuple[Tensor, Tensor] | None:
    """Members of the instances with a label, and what leans towards them; None if there is none."""
    found = [row for row in instances.table if row.label == text] if instances is not None else []
    if instances is None or not found:
        return None
    members, leaning = ([of(row.id) for row in found] for of in (instances.members, instances.leaning))
    return torch.stack(members).any(dim=0), torch.stack(leaning).any(dim=0)


def _name_instances(
    scores: Tensor, rivals: Tensor, seen: Tensor, instances: InstanceMap, least: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Members of the instances whose Gaussians score best on the mean, and what leans towards them, bool [N] each.

    None that score `least` or less.
    """
    ids = instances.instance().to(scores.device).clamp(min=0)
    ids = torch.where(seen.to(scores.device), ids, 0)
    count = len(instances.table) + 1
    size = torch.bincount(ids, minlength=count).clamp(min=1)
    mean = torch.bincount(ids, weights=scores.double(), minlength=count) / size
    rival = torch.bincount(ids, weights=rivals.double(), minlength=count) / size
    able = (mean > least) & (mean > rival)
    able[0] = False
    best = mean[able].max() if bool(able.any()) else torch.inf
    chosen = able & (mean >= SAME * best)
    leaning = chosen[instances.candidates[instances.level_index(), :, 0].to(scores.device).long().clamp(min=0)]
    return leaning & (instances.instance().to(scores.device) > 0), leaning


def _pick_click(state: EditState, term: Term, context: EditContext) -> Tensor:
    view = next((view for view in context.views if view.stem == term.text), None)
    if view is None:
        known = ", ".join(view.stem for view in context.views[:5]) or "none; give --views"
        raise InputError(f"select click:{term.text}: there is no such view ({known})")
    x, y = (int(number) for number in term.numbers)
    if not (0 <= x < view.camera.width and 0 <= y < view.camera.height):
        size = f"{view.camera.width} x {view.camera.height}"
        raise InputError(f"select click:{term.text},{x},{y}: outside the image, which is {size}")
    if context.instances is None and context.semantics is None:
        raise InputError(f"select click:{term.text},{x},{y}: needs --instances, or --semantics for what looks alike")
    return pick_at(state, context, view.camera, (x, y))


def pick_at(
    state: EditState, context: EditContext, camera: Camera, pixel: tuple[int, int], level: str | None = None
) -> Tensor:
    """The instance at a pixel, or where no instances are known what looks alike around it, bool [N]; maybe none.

    Args:
        state: The scene.
        context: Its instances or semantics.
        camera: The view.
        pixel: x and y, inside the image.
        level: Of the instances; the coarsest if None.

    Raises:
        InputError: The context has neither instances nor semantics, or there is no such level.
    """
    found, weights = contributors_at(state.gaussians, camera, pixel)
    nothing = torch.zeros_like(state.copies, dtype=torch.bool)
    if not len(found):
        return nothing
    if context.instances is not None:
        ids = context.instances.instance(level).to(state.rows.device)[state.rows]
        votes = torch.bincount(ids[found].clamp(min=0), weights=weights.double())
        votes[0] = 0.0
        if not bool(votes.max() > 0):
            return nothing
        return whole_instance(state, context.instances, int(votes.argmax())) & (state.copies == state.copies[found[0]])
    if context.semantics is None:
        raise InputError("a click needs instances, or semantics for what looks alike")
    return _looks_alike(state, context.semantics, found, weights)


def whole_instance(state: EditState, instances: InstanceMap, number: int) -> Tensor:
    """Members of an instance, and what is connected with them, undecided and leans towards it, bool [N].

    Raises:
        InputError: There is no such id.
    """
    parts = (instances.members(number), instances.leaning(number))
    members, leaning = (part.to(state.rows.device)[state.rows] for part in parts)
    return spread(state.gaussians.means, members, leaning)


def contributors_at(gaussians: Gaussians, camera: Camera, pixel: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The strongest contributors of a pixel (x, y), int64 [k], and their weights, float32 [k]; k is at most 8."""
    x, y = pixel
    found, weights = (part[y, x] for part in top_contributors(gaussians, camera, CLICK_DEPTH))
    return found[found >= 0].long(), weights[found >= 0]


def _pick_rows(state: EditState, term: Term) -> Tensor:
    count = len(state.gaussians)
    chosen = torch.zeros(count, dtype=torch.bool)
    for first, last in zip(term.numbers[::2], term.numbers[1::2], strict=True):
        if last >= count:
            raise InputError(f"select rows:{int(first)}-{int(last)}: the scene has rows 0 to {count - 1} at this step")
        chosen[int(first) : int(last) + 1] = True
    return chosen.to(state.gaussians.device)


def _looks_alike(state: EditState, semantics: Semantics, clicked: Tensor, weights: Tensor) -> Tensor:
    """The connected piece around the clicked Gaussians whose features agree with theirs."""
    features = torch.nn.functional.normalize(semantics.features.to(torch.float32), dim=1)[state.rows.cpu()]
    wanted = (features[clicked.cpu()] * weights.cpu()[:, None]).sum(dim=0)
    alike = (features @ torch.nn.functional.normalize(wanted, dim=0) > LOOKS_ALIKE).to(state.rows.device)
    alike[clicked[0]] = True
    piece = torch.from_numpy(pieces(state.gaussians.means, alike)).to(state.rows.device)
    return piece == piece[clicked[0]]


def pieces(means: Tensor, chosen: Tensor) -> NDArray[np.int64]:
    """Which connected piece each chosen Gaussian belongs to, int64 [N]; -1 for the others.

    Two are connected if one is among the nearest neighbors of the other and not too far away.
    """
    from scipy import sparse
    from scipy.sparse import csgraph
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(chosen.cpu().numpy() & torch.isfinite(means).all(dim=1).cpu().numpy())
    result = np.full(len(means), -1, np.int64)
    if len(rows) < 2:
        result[rows] = 0
        return result
    points = means.detach().double().cpu().numpy()[rows]
    distance, other = cKDTree(points).query(points, k=min(NEIGHBORS, len(rows) - 1) + 1)
    near = distance[:, 1:] <= LINK * max(float(np.median(distance[:, -1])), 1e-30)
    first, place = np.nonzero(near)
    links = sparse.coo_matrix((np.ones(len(first)), (first, other[:, 1:][first, place])), shape=(len(rows),) * 2)
    result[rows] = csgraph.connected_components(links, directed=False)[1]
    return result


def largest_pieces(means: Tensor, chosen: Tensor) -> Tensor:
    """The selection without scattered pieces, bool [N]."""
    piece = pieces(means, chosen)
    sizes = np.bincount(piece[piece >= 0], minlength=1)
    large = np.append(sizes >= LEAST_PIECE * sizes.max(), False)  # the last entry is for -1
    return torch.from_numpy(large[piece]).to(chosen.device)


def spread(means: Tensor, chosen: Tensor, around: Tensor) -> Tensor:
    """The selection with the connected pieces of what is around it, bool [N] (two thresholds, as Canny's, 1986)."""
    if not bool(chosen.any()):
        return chosen
    piece = torch.from_numpy(pieces(means, chosen | around)).to(chosen.device)
    met = torch.zeros(int(piece.max()) + 2, dtype=torch.bool, device=chosen.device)  # the last entry is for -1
    met[piece[chosen]] = True
    met[-1] = False
    return met[piece] | chosen


def grow(means: Tensor, chosen: Tensor, distance: float) -> Tensor:
    """Add what lies within a distance of the selection, or take away what lies within it of the rest [m], bool [N]."""
    from scipy.spatial import cKDTree

    finite = torch.isfinite(means).all(dim=1)
    points = means.detach().double().cpu().numpy()
    mask = (chosen & finite).cpu().numpy()
    rest = (~chosen & finite).cpu().numpy()
    source, target = (mask, rest) if distance > 0 else (rest, mask)
    if not source.any() or not target.any():
        return chosen
    reach = cKDTree(points[source]).query(points[target], distance_upper_bound=abs(distance))[0]
    touched = np.zeros(len(points), bool)
    touched[np.flatnonzero(target)[np.isfinite(reach)]] = True
    near = torch.from_numpy(touched).to(chosen.device)
    return chosen | near if distance > 0 else chosen & ~near
