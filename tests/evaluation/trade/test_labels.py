"""Names in pictures have places of their own."""

from itertools import combinations

from nmpm.evaluation.trade.labels import Box, boxes_along, boxes_around, choose_boxes

INSIDE = Box(0, 0, 400, 300)


def places(points, lines=(), width=60, height=10):
    candidates = [list(boxes_around(x, y, width, height)) for x, y in points]
    return candidates + [list(boxes_along(y, width, height, INSIDE)) for y in lines]


def markers(points):
    return [Box(x - 5, y - 5, x + 5, y + 5) for x, y in points]


def test_names_of_close_points_and_lines_cover_neither_each_other_nor_markers():
    points = [(100 + 12 * index, 150 + 3 * index) for index in range(6)]
    chosen = choose_boxes(places(points, lines=(140, 145)), markers(points), [], INSIDE)
    assert all(one.overlap(other) == 0 for one, other in combinations(chosen, 2))
    assert all(box.overlap(marker) == 0 for box in chosen for marker in markers(points))


def test_a_lonely_name_has_its_preferred_place_and_one_at_the_edge_stays_inside():
    candidates = places([(200, 150), (395, 295)])
    lonely, edge = choose_boxes(candidates, markers([(200, 150), (395, 295)]), [], INSIDE)
    assert lonely == candidates[0][0]
    assert edge.overlap(INSIDE) == edge.area


def test_a_name_avoids_thin_lines_but_covers_one_rather_than_another_name():
    line = Box(0, 155, 400, 157)
    (clear,) = choose_boxes(places([(200, 150)]), markers([(200, 150)]), [line], INSIDE)
    assert clear.overlap(line) == 0
    name, crossing = Box(0, 0, 60, 10), Box(0, 12, 60, 22)
    assert choose_boxes([[name, crossing]], [name], [Box(0, 15, 60, 16)], INSIDE) == [crossing]
