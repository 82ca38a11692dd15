"""People, by two small networks that have to agree.

Either alone takes things for people: on eleven images in twelve of empty rooms one of them finds some. What both are
sure of was a person, but for one rucksack in 70 images of 7 recordings.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...formats.errors import InputError
from ..networks.card import Card
from ..networks.registry import ModelStore
from ..networks.session import Network

_MAYBE = 0.3
"""Probability of the class from which pixels form a candidate."""
_SURE = 0.75
"""Both networks' mean over a candidate. Chosen on 70 images of 7 recordings: people had 0.82 and more, other things
0.67 and less, but for one rucksack."""
_MIN_SHARE = 0.001
_REACH = 0.12
"""Of the image's long side: what the person network sees so near a candidate belongs to it (feet, hair, hands)."""
_HARDLY = 0.1
"""Where the person network sees this little, the vague rim of the class is no person."""
_MARGIN = 0.012
"""Of the long side: the rim that is left out around people, whose borders are soft in both networks. With these
numbers 99.4 % of a woman pasted into 45 images of a room were found, 96.8 % in the worst of them, and 3.3 % of the
image beside her; with half the reach 98.6, 87.4 and 3.0 %."""


@dataclass(frozen=True)
class PeopleCards:
    """A network for people alone, and one with a class "person" among others."""

    person: Card
    classes: Card


def people_cards(store: ModelStore) -> PeopleCards | None:
    """Find the networks in the cache, the smallest of each kind; None unless both are there."""
    with_card = (m for m in store.models if "input" in store.families[m.family])
    here = sorted((m for m in with_card if store.is_here(m)), key=lambda m: m.bytes)
    cards = [store.card(m) for m in here]
    person = next((c for c in cards if c.task == "person"), None)
    classes = next((c for c in cards if c.kind in ("logits", "probabilities") and "person" in c.classes), None)
    return None if person is None or classes is None else PeopleCards(person, replace(classes, groups=()))


class PeopleFinder:
    """Opens the networks. Raises InputError when one is not what its card says."""

    def __init__(self, cards: PeopleCards, threads: int) -> None:
        self._person, self._classes = (Network(c, threads, "cpu") for c in (cards.person, cards.classes))

    def left_out(self, image: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(h, w) where an RGB image (h, w, 3) shows people, with a rim around them."""
        person = person_probability(self._person, image)
        # Half of the smallest piece has to be likelier a person than not: often that spares the larger network.
        if (person > 0.5).mean() < _MIN_SHARE / 2:
            return np.zeros(person.shape, bool)
        return join_people(person, self._class_probability(image))

    def _class_probability(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        card, box = self._classes.card, self._classes.box(image.shape[1], image.shape[0])
        scores = self._classes.run(image, box)["output"].astype(np.float32)
        if card.kind == "logits":
            scores = np.exp(scores - scores.max(0))
            scores /= scores.sum(0)
        return box.take(np.ascontiguousarray(scores[card.classes.index("person")]), card.align_corners)


def join_people(person: NDArray[np.float32], by_class: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(h, w) what both probabilities (h, w) take for people.

    A connected piece of the class counts when both are sure of it on average; what the person network sees around it
    is added.
    """
    count, piece, stats, _ = cv2.connectedComponentsWithStats((by_class > _MAYBE).astype(np.uint8))
    sizes = np.maximum(stats[:, cv2.CC_STAT_AREA], 1)
    sure = np.minimum(*(np.bincount(piece.ravel(), p.ravel(), count) / sizes for p in (person, by_class))) > _SURE
    sure &= sizes >= _MIN_SHARE * piece.size
    sure[0] = False
    found = sure[piece]
    if not found.any():
        return found
    side = max(person.shape)
    found = found & (person > _HARDLY) | (person > 0.5) & _grown(found, _REACH * side)
    return _grown(found, _MARGIN * side)


def _grown(area: NDArray[np.bool_], by: float) -> NDArray[np.bool_]:
    away = cv2.distanceTransform((~area).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away <= max(1.0, by))


def person_probability(network: Network, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w) in [0, 1]: how likely every pixel of an RGB image (h, w, 3) shows a person.

    Raises InputError when the output is no image of probabilities.
    """
    box = network.box(image.shape[1], image.shape[0])
    output = network.run(image, box)["output"]
    plane = output[0] if output.ndim == 3 and output.shape[0] == 1 else output
    if plane.ndim != 2:
        raise InputError(f"{network.card.model}: gave {output.shape} where one image of probabilities is expected")
    clean = np.clip(np.nan_to_num(plane.astype(np.float32), nan=0.0), 0, 1)
    return box.take(clean, network.card.align_corners)
