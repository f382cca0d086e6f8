// A small persistent thread pool of our own: torch and scikit-learn each bring an OpenMP, and mixing them breaks.
#pragma once

namespace gsparc {

using Body = void (*)(void* context, int task, int worker);

// Runs body(context, task, worker) for each task in [0, tasks) on up to `threads` threads, the caller among
// them; worker is in [0, threads). Tasks are taken in turn, so results must not depend on who runs them.
// Called while another call is running (a second Python thread), it does all the work alone.
void parallel(int tasks, int threads, Body body, void* context);

// The same for a callable. No std::function: it would be compiled once per instruction set under one name.
template <class F> inline void parallel_for(int tasks, int threads, F& body) {
    parallel(tasks, threads, [](void* f, int task, int worker) { (*static_cast<F*>(f))(task, worker); }, &body);
}

}  // namespace gsparc
