"""What is said of photographs that could not be placed."""

import numpy as np

from stages.init.sfm.diagnosis import Limits, failure, warnings_of
from stages.init.sfm.mapping import Solution
from stages.init.sfm.matching.two_view import TwoView
from stages.init.sfm.reconstruct import Attempt, Evidence

NAMES = ["right.jpg", "front.jpg", "left.jpg"]


def two_view(inliers, coherence=0.9):
    pose = np.hstack([np.eye(3), [[1.0], [0], [0]]])
    return TwoView(500, np.arange(inliers), coherence, pose)


def evidence(keypoints=(900, 900, 900), edges=None, linked=()):
    matches = {(0, 1): 500, (0, 2): 100, (1, 2): 400}
    displacement = dict.fromkeys(matches, 20.0)
    return Evidence(list(keypoints), matches, displacement, edges or {}, tuple(linked))


def solution(views):
    return Solution(
        {view: np.eye(4) for view in views}, dict.fromkeys(views, 500.0), np.zeros((1, 3)),
        np.zeros(1, int), np.zeros(1, int), np.zeros((1, 2)), np.zeros(1),
    )  # fmt: skip


def test_all_placed_and_determined_needs_no_word():
    assert warnings_of(Attempt(solution([0, 1, 2]), evidence(), True, True), NAMES) == []


def test_an_unplaced_photograph_is_named_with_its_best_match():
    edges = {(0, 1): two_view(200), (1, 2): two_view(40, 0.3), (0, 2): two_view(30, 0.2)}
    (text,) = warnings_of(
        Attempt(solution([0, 1]), evidence(edges=edges, linked=[(0, 1)]), True, True), NAMES
    )
    assert "1 of 3 photographs" in text
    assert "'front.jpg' and 'left.jpg' share too little: 400 spots" in text
    assert "40 (10 %)" in text
    assert "more than 35 degrees" in text
    assert "no more than 20 degrees" in text


def test_matches_by_chance_may_be_of_another_thing_and_many_are_no_wide_angle():
    for inliers, said, unsaid in (
        (12, "or one shows something else", "few spots"),
        (120, "more than 35 degrees apart.", "something else"),
        (220, "So few spots are in photographs that are small", "35 degrees"),
    ):
        edges = {(0, 1): two_view(200), (1, 2): two_view(inliers, 0.4)}
        (text,) = warnings_of(
            Attempt(solution([0, 1]), evidence(edges=edges, linked=[(0, 1)]), True, True), NAMES
        )
        assert said in text
        assert unsaid not in text


def test_a_blurred_photograph_is_called_so():
    blurred = evidence(keypoints=(900, 900, 120))
    (text,) = warnings_of(Attempt(solution([0, 1]), blurred, True, True), NAMES)
    assert "'left.jpg' shows only 120 distinct spots where the others show 900" in text


def test_a_photograph_that_contradicts_the_others_is_called_so():
    edges = {(0, 1): two_view(200), (1, 2): two_view(150)}
    found = evidence(edges=edges, linked=[(0, 1), (1, 2)])
    (text,) = warnings_of(Attempt(solution([0, 1]), found, True, True), NAMES)
    assert "'left.jpg' matches 'front.jpg' (150 spots agree), but contradicts" in text


def test_an_undetermined_focal_length_says_what_to_do():
    (text,) = warnings_of(Attempt(solution([0, 1, 2]), evidence(), False, False), NAMES)
    assert "undetermined" in text
    assert "EXIF" in text
    assert "init.focal" in text


def test_every_gap_is_named():
    edges = {(0, 1): two_view(30, 0.3), (1, 2): two_view(20, 0.3)}
    text = failure(Attempt(None, evidence(edges=edges), True, False), NAMES, Limits(3, 2.0))
    assert "'right.jpg' and 'front.jpg' share too little: 500 spots" in text
    assert "'front.jpg' and 'left.jpg' share too little: 400 spots" in text
    assert "'right.jpg' and 'left.jpg'" not in text
    assert "init.focal" not in text  # it is known


def test_linked_photographs_without_a_solution_contradict_each_other():
    edges = {(0, 1): two_view(200), (1, 2): two_view(150)}
    found = evidence(edges=edges, linked=[(0, 1), (1, 2)])
    text = failure(Attempt(None, found, False, False), NAMES, Limits(3, 2.0))
    assert "contradict each other" in text


def test_unsharp_photographs_are_said_first_and_not_called_too_far_apart():
    edges = {(0, 1): two_view(30, 0.3), (1, 2): two_view(20, 0.3)}
    attempt = Attempt(None, evidence(edges=edges), False, False)
    text = failure(attempt, NAMES, Limits(3, 2.0), [0, 1, 2])
    assert text.startswith("'right.jpg', 'front.jpg', 'left.jpg' are not sharp: shaken")
    assert "share too little: 500 spots" in text
    assert "degrees" not in text, "nor is a photograph between them asked for"
    one = failure(attempt, NAMES, Limits(3, 2.0), [2])
    assert one.startswith("'left.jpg' is not sharp")
    assert one.count("more than 35 degrees") == 1, "of the pair that is sharp"


def test_a_photograph_that_is_far_too_bright_is_not_just_called_unsharp():
    edges = {(0, 1): two_view(30, 0.3), (1, 2): two_view(20, 0.3)}
    attempt = Attempt(None, evidence(edges=edges), False, False)
    text = failure(attempt, NAMES, Limits(3, 2.0), bright=[2])
    assert text.startswith("'left.jpg' has too little fine detail left")
    assert "plain white in good part: far too bright" in text and "less light" in text
    assert "shaken" not in text and text.count("more than 35 degrees") == 1
    edges = {(0, 1): two_view(200), (1, 2): two_view(40, 0.3)}
    attempt = Attempt(solution([0, 1]), evidence(edges=edges, linked=[(0, 1)]), True, True)
    (text,) = warnings_of(attempt, NAMES, bright=[2])
    assert "far too bright" in text and "35 degrees" not in text


def test_an_unsharp_photograph_that_is_left_out_is_called_so():
    edges = {(0, 1): two_view(200), (1, 2): two_view(40, 0.3)}
    found = evidence(edges=edges, linked=[(0, 1)])
    (text,) = warnings_of(Attempt(solution([0, 1]), found, True, True), NAMES, [0, 2])
    assert "'left.jpg' is not sharp" in text
    assert "'right.jpg' is not sharp" not in text, "it was placed"
    assert "more than 35 degrees" not in text


def test_photographs_of_nothing_are_called_so_and_nothing_else():
    attempt = Attempt(None, evidence(keypoints=(3, 0, 900)), False, False)
    text = failure(attempt, NAMES, Limits(3, 2.0), [], [0, 1])
    assert text.startswith("'right.jpg', 'front.jpg' show nothing to match: an even surface")
    for other in ("sharp", "blurred", "degrees", "spots"):
        assert other not in text, "the third alone can't be placed, whatever it is"


def test_a_photograph_of_nothing_among_others_does_not_hide_why_these_fail():
    edges = {(0, 1): two_view(30, 0.3)}
    found = evidence(keypoints=(900, 900, 3), edges=edges)
    text = failure(Attempt(None, found, False, False), NAMES, Limits(2, 2.0), [1], [2])
    assert text.startswith("'left.jpg' shows nothing to match")
    assert "'front.jpg' is not sharp" in text
    assert "'right.jpg' and 'front.jpg' share too little: 500 spots" in text
    assert "blurred" not in text


def test_a_photograph_of_nothing_that_is_left_out_is_called_so():
    edges = {(0, 1): two_view(200), (1, 2): two_view(4, 0.3)}
    found = evidence(keypoints=(900, 900, 3), edges=edges, linked=[(0, 1)])
    (text,) = warnings_of(Attempt(solution([0, 1]), found, True, True), NAMES, [], [0, 2])
    assert "left out: 'left.jpg'. 'left.jpg' shows nothing to match" in text
    assert "'right.jpg'" not in text, "it was placed"
    assert "blurred" not in text and "photograph between" not in text
