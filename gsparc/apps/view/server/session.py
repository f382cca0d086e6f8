"""A server for any number of clients: what each sees, the ends that it may drag, and the answers
that follow its hand.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike

from gsparc.apps.maps.area import Grid
from gsparc.apps.maps.layers import Legend
from gsparc.apps.view.answer import PlaceAnswer, predict_answer
from gsparc.apps.view.building import GAUSSIANS, PATHS, RAYS, SPHERE, VALUES, draw_rays
from gsparc.apps.view.latest_job import LatestJobQueue
from gsparc.apps.view.reasons import answer_markdown, explain_level, legend_html, panel_image
from gsparc.apps.view.scene import EXTENT, Points
from gsparc.apps.view.server.draw import draw_ground_grid, draw_scene, set_first_view
from gsparc.apps.view.site_view import Plane, SiteView, plane_sheet, refine_plane, weakest_place
from gsparc.base.errors import DataError
from gsparc.data.schema import ENDS

FIRST_PLACE, WEAKEST = "first place", "next weak place"
PLANE = "plane"
SHOWN = {VALUES: "measured points", GAUSSIANS: "Gaussians"}  # that can be hidden


class Session:
    """Everything of one client; callbacks only note what is wanted, a `LatestJobQueue` does it."""

    def __init__(self, client: Any, view: SiteView, work: LatestJobQueue) -> None:
        self.client, self.view, self.work = client, view, work
        self.site = view.viewed.site
        self.station = self.chosen_station = view.viewed.stations[0]
        self.one = view.station(self.station)
        self.places = {
            end: np.asarray(at, float) for end, at in view.initial_places(self.station).items()
        }
        self.plane: Plane | None = None
        self.visited: list[np.ndarray] = []  # weak places of it, one after another
        self.power: Legend | None = None  # of the plane, where it is predicted
        self.nodes: dict[str, Any] = {}
        self.gizmos: dict[str, Any] = {}
        self.sphere = view.sphere(self.station)
        self._draw_still()
        set_first_view(client.camera)
        self._panel()
        self._add_gizmos()
        self.want_answer()
        self.want_plane()

    @property
    def scene(self) -> Any:
        """Of the station that is shown."""
        return self.one.scene

    # -- drawing what stands still -----------------------------------------------------------------

    def _draw_still(self) -> None:
        api = self.client.scene
        api.set_up_direction("+z")
        self.nodes = draw_scene(api, self.scene, self.nodes)
        self.cell = draw_ground_grid(api, self.scene)
        # About the middle of the frame, moved to the receiver with every answer
        if self.sphere is not None:
            around = self.scene.frame.middle + self.sphere.offsets
            dots = Points(SPHERE, around, np.zeros(around.shape, np.uint8), self.sphere.size)
            self.nodes[SPHERE] = dots.draw(api, self.scene.frame)

    def _add_gizmos(self) -> None:
        for end, place in self.places.items():
            gizmo = self.client.scene.add_transform_controls(
                f"/{end}",
                scale=0.2 * EXTENT,
                disable_rotations=True,
                depth_test=False,
                position=self.scene.frame.to_drawn(place),
            )
            self.client.scene.add_icosphere(
                f"/{end}/dot", radius=0.014 * EXTENT, color=(214, 39, 40)
            )
            self.client.scene.add_label(
                f"/{end}/name", ENDS[end], position=(0, 0, 0.03 * EXTENT), anchor="bottom-center"
            )
            gizmo.on_update(self._dragged(end))
            self.gizmos[end] = gizmo

    # -- the panel ---------------------------------------------------------------------------------

    def _panel(self) -> None:
        gui, viewed = self.client.gui, self.view.viewed
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        self.title = gui.add_markdown(f"**{self.scene.title}**")
        if len(viewed.stations) > 1:
            names = tuple(str(name) for name in viewed.stations)
            choice = gui.add_dropdown("station", names, initial_value=names[0])
            choice.on_update(lambda event: self._station_changed(event.target.value))
        self.answer_text = gui.add_markdown("asking ...")
        self.picture: Any = None
        self.vectors = {}
        for end, place in self.places.items():
            vector = gui.add_vector3(f"{ENDS[end]} [m]", tuple(np.round(place, 3)), step=0.01)
            self._on(vector, partial(self._move, end))
            self.vectors[end] = vector
        row = [FIRST_PLACE] + ([WEAKEST] if self.view.grid is not None else [])
        buttons = gui.add_button_group("go to", row)
        buttons.on_click(lambda event: self._go(event.target.value))
        with gui.add_folder("Colours"):
            self.legend = gui.add_html("")
        self._layers_panel(gui)
        with gui.add_folder("Notes", expand_by_default=False):
            gui.add_markdown("\n".join(f"- {note}" for note in self._notes()))
        self._legends()

    def _layers_panel(self, gui: Any) -> None:
        with gui.add_folder("Shown"):
            for name in filter(self.nodes.__contains__, SHOWN):
                self._on(gui.add_checkbox(SHOWN[name], True), partial(self._show_part, name))
            if self.view.grid is not None:
                self.laid = gui.add_checkbox("plane of predicted power", True)
                self._on(self.laid, lambda value: self.want_plane())
                self.progress = gui.add_markdown("")
                low, high = self.view.viewed.heights()
                first = round(self.view.grid.height, 2)
                self.height = gui.add_slider(
                    "height [m]", min(low, first), max(high, first), 0.01, first
                )
                self._on(self.height, lambda value: self.want_plane())

    def _notes(self) -> list[str]:
        note = (
            "both ends moved: measured points are where the receiver was, wherever its transmitter"
        )
        if not self.site.paired:
            still = ENDS[self.site.still_end]
            note = f"the {still} stood still when measured: the model knows it there alone"
        return [*self.scene.notes, f"grid: {self.cell:g} m", note]

    def _on(self, handle: Any, act: Any) -> None:
        """Do something with a value that the client changed, not with one that we set."""

        async def changed(event: Any) -> None:
            if event.client is not None:
                act(event.target.value)

        handle.on_update(changed)

    # -- what the hand does ------------------------------------------------------------------------

    def _dragged(self, end: str) -> Any:
        async def moved(event: Any) -> None:
            self.places[end] = self.scene.frame.to_world(event.target.position)
            self._moved(end)

        return moved

    def _move(self, end: str, position: ArrayLike) -> None:
        self.places[end] = place = np.asarray(position, np.float64)
        self.gizmos[end].position = self.scene.frame.to_drawn(place)
        self._moved(end)

    def _moved(self, end: str) -> None:
        self.want_answer()
        if end == "tx" and self.site.paired:
            self.want_plane()  # which shows the power of this transmitter

    def _go(self, where: str) -> None:
        moving = self.view.viewed.moving[-1]
        place = self.view.initial_places(self.station)[moving]
        if where == WEAKEST and self.plane is not None:
            weak_place = weakest_place(self.plane, self.visited)
            if weak_place is None:  # all were visited
                self.visited.clear()
                weak_place = weakest_place(self.plane)
            if weak_place is not None:
                self.visited.append(weak_place)
                place = weak_place
        self._move(moving, place)

    def _show_part(self, name: str, visible: bool) -> None:
        self.nodes[name].visible = visible
        self._legends()

    def _station_changed(self, value: str) -> None:
        """Called in a thread of its own: a station that nobody saw yet takes seconds to make."""
        self.chosen_station = value
        if value not in self.view.made:
            self.title.content = f"**{value} is being prepared ...**"
        self.view.station(value)
        # Meanwhile another may have been chosen: only the last is shown.
        if self.chosen_station == value:
            self.work.put(
                (self.client.client_id, "station"), partial(self._show_station, value), urgent=True
            )

    # -- what the worker does ----------------------------------------------------------------------

    def want_answer(self) -> None:
        """Have the present places answered."""
        self.work.put((self.client.client_id, "answer"), self._answered, urgent=True)

    def want_plane(self) -> None:
        """Have the present plane drawn."""
        self.work.put((self.client.client_id, PLANE), self._planes)

    def _show_station(self, name: str) -> Iterator[None]:
        self.station, self.one = name, self.view.station(name)
        visibility = {name: self.nodes[name].visible for name in SHOWN if name in self.nodes}
        # All at once, or a client sees half of two stations.
        with self.client.atomic():
            self._draw_still()
            for name in visibility.keys() & self.nodes.keys():
                self.nodes[name].visible = visibility[name]
        self.title.content = f"**{self.scene.title}**"
        self._legends()
        self.want_answer()
        self.want_plane()
        yield

    def _answered(self) -> Iterator[None]:
        try:
            answer = predict_answer(self.view.viewed.predictor_of(self.station), dict(self.places))
        except ValueError as error:
            self.answer_text.content = f"**{error}**"
            return
        self._show(answer)
        # The picture has a key of its own: a later answer replaces it before it is drawn.
        self.work.put((self.client.client_id, "panel"), partial(self._panel_of, answer))
        yield

    def _show(self, answer: PlaceAnswer) -> None:
        why = explain_level(answer, self.view.viewed.moving[-1], self.one.tree)
        rays, first = (
            draw_rays(answer, self.view.extent(self.station)) or (),
            RAYS not in self.nodes,
        )
        with self.client.atomic():
            self.answer_text.content = answer_markdown(
                answer, self.view.viewed.moving, why, self.view.unit
            )
            for end in self.vectors:
                self.vectors[end].value = tuple(float(v) for v in np.round(answer.ends[end], 3))
            if answer.spectrum is not None and self.sphere is not None and "rx" in answer.ends:
                self.nodes[SPHERE].position = self.scene.frame.to_drawn(answer.ends["rx"])
                self.nodes[SPHERE].colors = self.sphere.colours(answer.spectrum)
            for part in rays:
                self.nodes[part.name] = part.draw(self.client.scene, self.scene.frame)
        if rays and first:
            self._legends()

    def _panel_of(self, answer: PlaceAnswer) -> Iterator[None]:
        """The picture of an answer, which takes longer than the answer:
        a drag does not wait for it.
        """
        image = panel_image(answer, self.site)
        if image is not None and self.picture is None:
            order = self.answer_text.order + 0.1
            self.picture = self.client.gui.add_image(image, jpeg_quality=85, order=order)
        elif image is not None:
            self.picture.image = image
        yield

    def _planes(self) -> Iterator[None]:
        self.power = None
        if self.view.grid is not None and self.laid.value:
            yield from self._predicted_plane(
                replace(self.view.grid, height=float(self.height.value))
            )
        elif PLANE in self.nodes:
            self.nodes.pop(PLANE).remove()
        self._legends()
        yield

    def _predicted_plane(self, grid: Grid) -> Iterator[None]:
        predictor = self.view.viewed.predictor_of(self.station)
        other = self.places["tx"].tolist() if self.site.paired else None
        legend, begin = self.one.power, time.perf_counter()
        self.visited.clear()
        for plane in refine_plane(predictor, grid, other):
            if plane is None:
                yield
                continue
            first = self.power is None
            legend = legend or Legend.over(f"predicted power [{self.view.unit}]", plane.level_db)
            self.plane, self.power = plane, legend
            part = plane_sheet(PLANE, grid, plane.level_db, legend, self.one.dot / 2)
            self.nodes[PLANE] = part.draw(self.client.scene, self.scene.frame)
            if first:
                self._legends()
            suffix = "" if plane.stride == 1 else f", so far one of {plane.stride**2} computed"
            text = f"{int(grid.inside.sum())} cells of {grid.step:.3g} m{suffix}"
            self.progress.content = f"{text}, {time.perf_counter() - begin:.1f} s"
            yield

    def _legends(self) -> None:
        legends = self.scene.legends
        entries = [
            legends[name] for name in legends if name in self.nodes and self.nodes[name].visible
        ]
        entries += [PATHS] if RAYS in self.nodes else []
        entries += [self.power] if PLANE in self.nodes and self.power is not None else []
        self.legend.content = legend_html(entries, self.scene.parts)


log = logging.getLogger(__name__)


class PageServer:
    """Serves a model until it is stopped.

    Args:
        view: the model.
        host: address to listen at; 127.0.0.1 lets nobody else in.
        port: the next free one is taken where it is in use; 0: any.

    Raises:
        DataError: no such address here.
    """

    def __init__(self, view: SiteView, host: str = "127.0.0.1", port: int = 8080) -> None:
        self.view, self.work = view, LatestJobQueue()
        self.sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._gone: set[int] = set()  # clients that left before their session was there
        view.station(view.viewed.stations[0])  # made before anyone waits for it
        try:
            self.server = viser.ViserServer(host=host, port=port, label="gsparc", verbose=False)
        except OSError as error:
            self.work.close()
            raise DataError(
                f"host={host} port={port}: cannot listen there ({error.strerror})"
            ) from None
        self.server.scene.set_up_direction("+z")
        self.server.on_client_connect(self._came)
        self.server.on_client_disconnect(self._went)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def _came(self, client: Any) -> None:
        session = Session(client, self.view, self.work)
        with self._lock:
            gone = client.client_id in self._gone  # while its session was made
            self._gone.discard(client.client_id)
            if not gone:
                self.sessions[client.client_id] = session
        if gone:
            self.work.drop_client(client.client_id)
            return
        log.info("client %d connected, %d in all", client.client_id, len(self.sessions))

    def _went(self, client: Any) -> None:
        with self._lock:
            if self.sessions.pop(client.client_id, None) is None:
                self._gone.add(client.client_id)
        self.work.drop_client(client.client_id)
        log.info("client %d left, %d in all", client.client_id, len(self.sessions))

    def run(self) -> None:
        """Serve until Ctrl-C."""
        try:
            while True:
                time.sleep(0.5)
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()

    def stop(self) -> None:
        """Let all clients go."""
        self.work.close()
        self.server.stop()
